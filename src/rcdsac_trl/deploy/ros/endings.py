"""Which signals end a node, after a last command to stand."""

import signal


def ending_signals() -> list[signal.Signals]:
    """Return the signals that ask a program to end: Ctrl-C, SIGTERM, and a terminal that was closed.

    The last is left out where this process was started to outlive its terminal, as ``nohup`` does.
    """
    outlives = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [signal.SIGINT, signal.SIGTERM, *([] if outlives else [signal.SIGHUP])]
