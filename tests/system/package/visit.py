"""Visits the installed service from where it runs, and prints what it was shown; the virtual board has no network.

visit.py modbus ADDRESS PORT UNIT POINT COUNT    holding registers, as JSON
visit.py telnet ADDRESS PORT PASSWORD            logs in, looks at the status, leaves
visit.py menu [COMMAND WORD...]                  the menu in a terminal: it comes up, and is left

Whoever gets no answer ends with an error. It needs nothing but Python: a software processor takes ten seconds to import
pymodbus.
"""

from __future__ import annotations

import json
import os
import pty
import re
import select
import socket
import struct
import sys
from collections.abc import Callable
from typing import Final

LIMIT_S: Final = 60.0
CONNECT_S: Final = 5.0
PROMPT: Final = "rtugate> "
IAC_COMMAND: Final = re.compile(rb"\xff[\xfb-\xfe].", re.DOTALL)  # RFC 854: will, won't, do, don't
DO, DONT, WILL, WONT = b"\xff\xfd", b"\xff\xfe", b"\xff\xfb", b"\xff\xfc"
ANSWERS: Final = {WILL: DO, DO: WONT, WONT: DONT, DONT: WONT}  # it may echo, and there is nothing that we do


def modbus(address: str, port: str, unit: str, point: str, count: str) -> str:
    """MODBUS Messaging on TCP/IP, section 3.1; function 3."""
    with socket.create_connection((address, int(port)), CONNECT_S) as connection:
        connection.settimeout(LIMIT_S)
        connection.sendall(struct.pack(">HHHBBHH", 1, 0, 6, int(unit), 3, int(point), int(count)))
        with connection.makefile("rb") as came:
            length = int.from_bytes(came.read(6)[4:])
            body = came.read(length)
    assert body[1] == 3, f"exception {body[2]}"
    return json.dumps(struct.unpack(f">{body[2] // 2}H", body[3:]))


def telnet(address: str, port: str, password: str) -> str:
    with socket.create_connection((address, int(port)), CONNECT_S) as connection:
        connection.settimeout(LIMIT_S)

        def receive() -> str:
            came = connection.recv(4096)
            for command in IAC_COMMAND.findall(came):
                connection.sendall(ANSWERS[command[:2]] + command[2:])
            return IAC_COMMAND.sub(b"", came).decode()

        said = until("Password: ", receive)
        connection.sendall(f"{password}\r\n".encode())
        said += until(PROMPT, receive)
        connection.sendall(b"i")
        said += until("back.", receive)
        connection.sendall(b"mq")
        return said + until("", receive)


def menu(*before: str) -> str:
    """*before*: words of a command that runs it, setpriv's for example."""
    process, terminal = pty.fork()
    if process == 0:
        command = [*before, "rtugate", "menu"]
        os.execvp(command[0], command)  # noqa: S606 - no shell is needed

    def receive() -> str:
        assert select.select([terminal], [], [], LIMIT_S)[0], "nothing more comes"
        try:
            return os.read(terminal, 4096).decode()
        except OSError:  # the program has ended
            return ""

    said = until(PROMPT, receive)
    os.write(terminal, b"q")
    said += until("", receive)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    assert code == 0, f"it ended with {code}: {said}"
    return said


def until(awaited: str, receive: Callable[[], str]) -> str:
    """Return what comes until *awaited* is the end of it; with "", until the other side ends."""
    said = ""
    while not (awaited and said.endswith(awaited)):
        came = receive()
        if not came:
            assert not awaited, f"{awaited!r} never comes, only {said!r}"
            break
        said += came
    return said


VISITS: Final[dict[str, Callable[..., str]]] = {"modbus": modbus, "telnet": telnet, "menu": menu}

if __name__ == "__main__":
    print(VISITS[sys.argv[1]](*sys.argv[2:]))
