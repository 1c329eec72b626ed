"""The real gateway with faults in it, and what becomes of it.

``faults`` and ``__main__`` are the program, ``python -m tests.hanging run -c FILE --state DIR``, which needs nothing
but the gateway; ``bench`` and ``table`` are the tests' side, which run it and note each thing it does with its time.
"""
