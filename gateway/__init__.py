"""rtugate: a Modbus gateway for a small Linux computer. README.md has the map of this package."""

__version__ = "0.1.0"
