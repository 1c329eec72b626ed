"""RTU frames of a shared line, annotated.

A CRC that stands in hexadecimal was printed by somebody else (a manual, the serial line guide) or worked out by hand,
the others are added by ``with_crc``, which knows no table.
"""

from __future__ import annotations

from gateway.modbus.framing import (
    Frame,
)
from tests.modbus import wire, with_crc

POLL = wire("""
    02      # unit 2
    04      # read input registers
    00 00   # from address 0
    00 06   # 6 of them
    70 3B   # CRC, low byte first
""")
POLLED = Frame(2, b"\x04\x00\x00\x00\x06")
VOLTAGES = wire("""
    02              # unit 2, a three-phase meter
    04              # read input registers
    0C              # 12 bytes
    43 66 33 34     # phase 1, a float: 230.2 V
    43 65 CC CD     # phase 2: 229.8 V
    43 67 00 00     # phase 3: 231.0 V
    4C 51           # CRC
""")
MEASURED = Frame(2, VOLTAGES[1:-2])
METER = wire("""
    01              # unit 1, the example of a meter's manual
    04              # read input registers
    04              # 4 bytes
    43 66 33 34     # 230.2 V
    1B 38           # CRC
""")
REFUSAL = wire("""
    02      # unit 2
    84      # read input registers, refused
    02      # illegal data address
    32 C1   # CRC
""")
OTHERS_POLL = wire("""
    11      # unit 17
    03      # read holding registers
    00 6B   # from address 107
    00 03   # 3 of them
    76 87   # CRC
""")
OTHERS_REPLY = wire("""
    11                  # unit 17
    03                  # read holding registers
    06                  # 6 bytes
    AE 41 56 52 43 40   # 44609, 22098, 17216
    49 AD               # CRC
""")
OTHERS_WRITE = with_crc("""
    05              # unit 5
    10              # write multiple registers
    00 01           # from address 1
    00 02           # 2 of them
    04              # 4 bytes
    00 0A 01 02     # 10, 258
""")
OTHERS_ECHO = with_crc("05 10 00 01 00 02  # unit 5 has written 2 registers from address 1")
TO_ALL = with_crc("00 06 00 01 00 03  # unit 0: write 3 to register 1")


def frame_of(data: bytes) -> Frame:
    return Frame(data[0], data[1:-2])


def damaged(data: bytes) -> bytes:
    """*data* with a bit of its CRC turned over."""
    return data[:-1] + bytes([data[-1] ^ 0x10])
