"""The Modbus protocol as pure code: bytes in, values out; no ports, no clock, no threads."""
