"""A TCP client that asks as fast as it is answered; prints its requests a second."""

from __future__ import annotations

import socket
import sys
import time


def rate(port: int, seconds: float, count: int) -> float:
    """Return requests a second, one outstanding at a time."""
    request = bytes.fromhex("0001 0000 0006 01 03 0000") + count.to_bytes(2, "big")
    size, done = 9 + 2 * count, 0
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        began_s = time.monotonic()
        while time.monotonic() < began_s + seconds:
            connection.sendall(request)
            reply = connection.recv(512)
            assert len(reply) == size
            done += 1
        return done / (time.monotonic() - began_s)


if __name__ == "__main__":
    print(rate(int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])))
