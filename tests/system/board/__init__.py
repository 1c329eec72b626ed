"""A virtual board: a small PC in qemu that boots Debian 13, with four UARTs and an i6300esb hardware watchdog.

``image`` makes what it boots from, once; ``machine`` is the board itself: its power, its wires, and what it is ordered
to do; ``station`` is a board with rtugate on it, wired to a device, to an upper master and to a person's terminal. How
rtugate gets onto the board is one function, handed to ``station``.

What it refuses: hardware virtualisation (it has to run where there is none, and to be the same everywhere), and to say
anything about a line's speed, parity or gaps: the UARTs take every setting, and bytes go through at once.
The processor is about ten times slower than the host's; its clocks run as the host's do.
"""
