"""What tshark, Wireshark's reader without a window, makes of frames: the fields of each, and its complaints.

Captures are written here, of packets that a tap has kept (``tapped``), so nothing is sniffed and nobody has to be root:
Modbus TCP and RTU over TCP as IPv4 with a TCP header, RTU on a serial line bare, with the link type that libpcap leaves
to its users.
"""

from __future__ import annotations

import os
import shutil
import socket
import struct
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.system.tapped import Kind, Packet

PORTS: dict[Kind, int] = {"tcp": 502, "rtu over tcp": 5020, "rtu": 0}
RAW_IP, USER_0 = 101, 147  # link types
NUMBERS = ["reference_num", "word_cnt", "bit_cnt", "byte_cnt", "bitval", "regval_uint16", "data", "and_mask", "or_mask"]
READ_WRITE = ["read_reference_num", "write_reference_num", "read_word_cnt", "write_word_cnt"]
IDENTITY = ["mei", "read_device_id", "object_id", "object_str_value", "conformity_level", "num_objects", "more_follows"]
COUNTERS = ["diagnostic.bus_message_count", "diagnostic.slave_message_count", "diagnostic.bus_exception_error_count"]
DIAGNOSTICS = ["diagnostic_code", "diagnostic.return_query_data.echo", *COUNTERS]
EVENTS = ["ev_status", "ev_count", "ev_msg_count", "event"]
MODBUS = ["func_code", "exception_code", *NUMBERS, *READ_WRITE, *IDENTITY, *DIAGNOSTICS, *EVENTS, "request_frame"]
COMPLAINTS = ["_ws.malformed", "_ws.expert.message"]
FIELDS = [
    *("frame.number", "mbtcp.trans_id", "mbtcp.unit_id", "mbrtu.unit_id", "mbrtu.crc16.status"),
    *(f"modbus.{name}" for name in MODBUS),
    *COMPLAINTS,
]
OPTIONS = [
    "mbrtu.crc_verification:TRUE",
    f"mbrtu.tcp.port:{PORTS['rtu over tcp']}",
    'uat:user_dlts:"User 0 (DLT=147)","mbrtu","0","","0",""',
]
SHORTEST_RTU = 5  # bytes; of shorter frames the dissector of RTU wants to know nothing: 7, 11, 12 and 17 have 4


# ------------------------------------------------------------------------------------------------ captures


def read(packets: Sequence[Packet], kind: Kind, folder: Path) -> list[dict[str, str]]:
    """Return tshark's fields of each packet, without the empty ones; several values have commas between them."""
    tshark = shutil.which("tshark")
    assert tshark, "tshark is missing: apt-get install tshark"
    capture = folder / "capture.pcap"
    capture.write_bytes(_pcap(packets, kind))
    command = [tshark, "-n", "-r", str(capture), "-T", "fields", "-E", "separator=/t", "-E", "aggregator=,"]
    command += [word for option in OPTIONS for word in ("-o", option)]
    command += [word for name in FIELDS for word in ("-e", name)]
    environment = os.environ | {"WIRESHARK_CONFIG_DIR": str(folder), "LC_ALL": "C.UTF-8"}  # nobody's preferences
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    lines = [line.split("\t") for line in done.stdout.splitlines()]
    assert len(lines) == len(packets)
    return [{name: value for name, value in zip(FIELDS, line, strict=True) if value} for line in lines]


def complaints(packets: Sequence[Packet], kind: Kind, folder: Path) -> list[str]:
    """Return what tshark finds wrong in *packets*: malformed ones, any expert's remark, a CRC that is not good."""
    found = []
    for packet, told in zip(packets, read(packets, kind, folder), strict=True):
        remarks = [f"{name} {told[name]}" for name in COMPLAINTS if name in told]
        if kind != "tcp" and len(packet.data) >= SHORTEST_RTU and told.get("mbrtu.crc16.status") != "1":
            remarks.append("the CRC is not good")
        if kind == "tcp" and "modbus.func_code" not in told:
            remarks.append("no Modbus")
        found += [f"{packet.data.hex(' ')}: {remark}" for remark in remarks]
    return found


def _pcap(packets: Sequence[Packet], kind: Kind) -> bytes:
    """Return a capture file, as of libpcap's pcap-savefile(5)."""
    head = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, USER_0 if kind == "rtu" else RAW_IP)
    bodies = [packet.data for packet in packets] if kind == "rtu" else _segments(packets, PORTS[kind])
    return head + b"".join(struct.pack("<IIII", at, 0, len(body), len(body)) + body for at, body in enumerate(bodies))


def _segments(packets: Sequence[Packet], port: int) -> Iterator[bytes]:
    """Each packet as one segment of a connection from 127.0.0.1 to 127.0.0.2, without checksums (RFC 791, RFC 793)."""
    sent = {True: 1, False: 1}
    for packet in packets:
        ends = [(40000, b"\x7f\0\0\x01"), (port, b"\x7f\0\0\x02")]
        (from_port, from_host), (to_port, to_host) = ends if packet.is_request else ends[::-1]
        numbers = sent[packet.is_request], sent[not packet.is_request]
        size = 40 + len(packet.data)
        yield (
            struct.pack(">BBHHHBBH", 0x45, 0, size, 0, 0, 64, socket.IPPROTO_TCP, 0)
            + from_host
            + to_host
            + struct.pack(">HHIIBBHHH", from_port, to_port, *numbers, 0x50, 0x18, 65535, 0, 0)
            + packet.data
        )
        sent[packet.is_request] += len(packet.data)
