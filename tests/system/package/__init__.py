"""Debian 13 in a folder, to install the package in: ``debian13`` makes it, ``talk`` is what runs inside.

There is no systemd in it, so units are not started: for that there is a virtual board (``tests/system/board``).
"""
