"""Who we are, to whoever asks by function 43/14, read device identification; and by function 17.

Pure. Basic and regular objects, as a stream or one by one (conformity level 0x82).

Source: application protocol V1.1b3, section 6.21.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gateway.errors import RequestRefused
from gateway.modbus.pdu import PDU_MAX, ExceptionCode

MEI_READ_DEVICE_ID: Final = 0x0E
BASIC, REGULAR, EXTENDED, INDIVIDUAL = 1, 2, 3, 4  # read device ID codes
CONFORMITY: Final = 0x82  # regular identification, stream and individual access
LAST_BASIC: Final = 2  # object identifiers 0 to 2 are basic, up to 0x7F regular
HEADER: Final = 7  # bytes before the first object
MORE_FOLLOWS: Final = 0xFF


@dataclass(frozen=True)
class Identity:
    """What functions 17 and 43 say: texts of printable ASCII."""

    vendor: str = "rtugate"
    product: str = "rtugate"
    revision: str = ""

    @property
    def objects(self) -> dict[int, bytes]:
        """The objects by identifier: vendor name, product code, revision; product name."""
        texts = {0: self.vendor, 1: self.product, 2: self.revision, 4: self.product}
        return {number: text.encode("ascii", "replace") for number, text in texts.items()}

    @property
    def server_id(self) -> bytes:
        """What function 17 says: one byte that is ours to choose, then all three texts."""
        return b"\x01" + f"{self.vendor} {self.product} {self.revision}".strip().encode("ascii", "replace")


def read_device_identification(pdu: bytes, identity: Identity) -> bytes:
    """Return the PDU that answers *pdu*, a request with function 43.

    raises: RequestRefused(1): another MEI type; (3): wrong length or code; (2): no such object, asked for by itself.
    """
    if len(pdu) < 2:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)
    if pdu[1] != MEI_READ_DEVICE_ID:
        raise RequestRefused(ExceptionCode.ILLEGAL_FUNCTION)
    if len(pdu) != 4 or not BASIC <= pdu[2] <= INDIVIDUAL:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)
    code, first = pdu[2], pdu[3]
    if code == INDIVIDUAL and first not in identity.objects:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_ADDRESS)
    return _reply(code, _asked(code, first, identity.objects))


def _asked(code: int, first: int, objects: dict[int, bytes]) -> dict[int, bytes]:
    """Return the objects meant; a stream that starts at none of them starts at the beginning."""
    if code == INDIVIDUAL:
        return {first: objects[first]}
    stream = {number: text for number, text in objects.items() if code != BASIC or number <= LAST_BASIC}
    return {number: text for number, text in stream.items() if first not in stream or number >= first}


def _reply(code: int, asked: dict[int, bytes]) -> bytes:
    """Return as many objects as fit, and where to go on with the rest."""
    body, count, rest = b"", 0, list(asked)
    while rest and HEADER + len(body) + 2 + len(asked[rest[0]]) <= PDU_MAX:
        number = rest.pop(0)
        body += bytes([number, len(asked[number])]) + asked[number]
        count += 1
    more = bytes([MORE_FOLLOWS, rest[0]]) if rest else bytes(2)
    return bytes([43, MEI_READ_DEVICE_ID, code, CONFORMITY]) + more + bytes([count]) + body
