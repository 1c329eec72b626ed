"""How much of a line's time its polls need: an estimate from the configuration alone.

A serial poll costs the characters of request and reply, two silences of 3.5 characters and the line's ``delay``; a
broadcast costs its request and the turnaround. The device's own thinking time is unknown and not counted: a load near
100 % is already too much. A transaction over TCP counts as 1 ms. Writes on change cost nothing.

Source: MODBUS over Serial Line V1.02, sections 2.5.1 and 2.5.2; application protocol V1.1b3, section 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gateway.config import LineConfig, MasterConfig, RequestConfig

TCP_TRANSACTION_S: Final = 0.001
SILENCE_CHARACTERS: Final = 3.5  # section 2.5.1.1
FIXED_SILENCE_S: Final = 0.00175  # above 19200 baud, section 2.5.1.1
WRITE_ECHO_BYTES: Final = 5  # function, address, value or quantity


@dataclass(frozen=True, slots=True)
class LineLoad:
    """What the polls of a line ask of it.

    percent:         of the line's time, when each poll keeps its cycle time; above 100 they cannot all.
    slowest_cycle_s: the longest time from one poll of a request to the next: one round of all requests in turn, or the
                     longest cycle time if that is more; 0 without polls.
    """

    percent: float
    slowest_cycle_s: float


def line_load(master: MasterConfig) -> LineLoad:
    """Estimate the load of *master*'s enabled requests, whether the line itself is enabled or not."""
    polls = [request for request in master.request if request.enabled and request.trigger == "cycle"]
    costs_s = [_cost_s(master, request) for request in polls]
    share = sum(cost_s / request.every for cost_s, request in zip(costs_s, polls, strict=True))
    slowest_s = max([sum(costs_s), *(request.every for request in polls)])
    return LineLoad(percent=100 * share, slowest_cycle_s=slowest_s)


def character_s(line: LineConfig) -> float:
    """Seconds that one character takes on a serial line: start, data, parity and stop bits."""
    bits = 1 + line.data_bits_used + (line.parity != "none") + line.stop_bits
    return bits / line.baudrate


def silence_s(line: LineConfig) -> float:
    """Seconds of silence between two frames on a serial line."""
    return FIXED_SILENCE_S if line.baudrate > 19200 else SILENCE_CHARACTERS * character_s(line)


def _cost_s(master: MasterConfig, request: RequestConfig) -> float:
    wait_s = master.turnaround if master.is_broadcast(request) else 0.0
    if master.is_tcp:
        return TCP_TRANSACTION_S + master.delay + wait_s
    characters = _frame_characters(master, _request_bytes(request))
    if not master.is_broadcast(request):
        characters += _frame_characters(master, _reply_bytes(request))
    return characters * character_s(master) + 2 * silence_s(master) + master.delay + wait_s


def _frame_characters(line: LineConfig, pdu_bytes: int) -> int:
    if line.framing_used == "ascii":
        return 1 + 2 * (1 + pdu_bytes + 1) + 2  # colon, unit and PDU and LRC as hex, CR LF
    return 1 + pdu_bytes + 2  # unit, PDU, CRC


def _data_bytes(request: RequestConfig) -> int:
    return (request.count + 7) // 8 if request.natural_table.is_bits else 2 * request.count


def _request_bytes(request: RequestConfig) -> int:
    many = request.code in (15, 16)
    return 6 + _data_bytes(request) if many else 5


def _reply_bytes(request: RequestConfig) -> int:
    return 2 + _data_bytes(request) if request.is_read else WRITE_ECHO_BYTES
