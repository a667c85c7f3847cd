"""Ctrl-C and SIGTERM in the process of a command: both end it as an error does, so that temporary files go.

A library whose callback is running may lose the exception that a signal raises, or turn it into an error of its own.
The signals are therefore noted, and the exit by SIGTERM is repeated until the command has ended.
"""

import signal

# Exit codes of an interrupted command and of a terminated one, as a shell says of SIGINT and SIGTERM.
INTERRUPTED_CODE = 130
TERMINATED_CODE = 143
# Time after which an exit by SIGTERM is repeated [s]; to remove temporary files takes less (our choice).
EXIT_AGAIN = 5.0

received: list[int] = []
"""Exit codes of the signals that this process has received."""


def hear() -> None:
    """Let this process end by Ctrl-C and SIGTERM."""
    signal.signal(signal.SIGTERM, _terminate)
    # in the background of a shell it is ignored, and stays so
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def ignore() -> None:
    """Ignore Ctrl-C from now on."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def stop_repeating() -> None:
    """Let no further exit follow a SIGTERM."""
    # Windows has no timer
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _interrupt(number: int, frame: object) -> None:
    received.append(INTERRUPTED_CODE)
    raise KeyboardInterrupt


def _terminate(number: int, frame: object) -> None:
    """Raise an exit, now and after `EXIT_AGAIN`; further SIGTERM are ignored."""
    received.append(TERMINATED_CODE)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, _terminate)
        signal.setitimer(signal.ITIMER_REAL, EXIT_AGAIN)
    raise SystemExit(TERMINATED_CODE)
