"""Small configurations for tests: entries with only what is required, to which a test adds what it is about."""

from __future__ import annotations

from typing import Any

from gateway.config import MasterConfig, RequestConfig
from gateway.config_checks import validate

REQUEST = {"unit": 17, "function": 3, "address": 107, "count": 3, "point": 0}
MASTER = {"name": "field", "line": "/dev/ttyS2"}
SLAVE = {"name": "scada", "line": "tcp://0.0.0.0:502", "unit": 1}
IO = {"name": "door", "kind": "gpio-in", "chip": "/dev/gpiochip0", "line": "17", "point": 0}


def a_request(**keys: Any) -> RequestConfig:
    return RequestConfig.model_validate(REQUEST | keys)


def a_master(*requests: dict[str, Any], **keys: Any) -> MasterConfig:
    return MasterConfig.model_validate(MASTER | {"request": [REQUEST | request for request in requests]} | keys)


def with_requests(*requests: dict[str, Any], **keys: Any) -> dict[str, Any]:
    return {"master": [MASTER | {"request": [REQUEST | request for request in requests]} | keys]}


def said(data: dict[str, Any]) -> list[str]:
    return [finding.message for finding in validate(data)[1]]
