"""Print, as JSON, the threads of BLAS in and around calls of calib, in a process that starts with three of them."""

import json
from contextlib import suppress
from threading import Event, Thread

import scipy.linalg  # noqa: F401  (brings a BLAS beside numpy's)
from threadpoolctl import threadpool_info, threadpool_limits

from calib.arguments import checked


def threads() -> list[int]:
    return sorted({pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"})


@checked
def call(fail: bool = False) -> list[int]:
    if fail:
        raise KeyboardInterrupt
    return threads()


@checked
def steps():
    yield threads()
    yield threads()


@checked
def nested() -> list[list[int]]:
    return [call(), threads()]


@checked
def waiting(begun: Event, go_on: Event) -> list[int]:
    begun.set()
    go_on.wait(30.0)
    return threads()


def overlapping() -> list[list[int]]:
    """Return the threads of a call that begins later, ends later, and after the first has ended; then after both."""
    begun = [Event(), Event()]
    go_on = [Event(), Event()]
    counts: list[list[int]] = []

    def count_in_call(k: int) -> None:
        counts.append(waiting(begun[k], go_on[k]))

    calls = [Thread(target=count_in_call, args=(k,)) for k in range(2)]
    for k in range(2):
        calls[k].start()
        begun[k].wait(30.0)
    for k in range(2):
        go_on[k].set()
        calls[k].join(30.0)
        counts.append(threads())
    return counts


def main() -> None:
    threadpool_limits(3)
    counts = {"before": threads(), "call": call(), "after": threads(), "nested": nested()}
    with suppress(KeyboardInterrupt):
        call(fail=True)
    counts["after an exception"] = threads()
    generator = steps()
    counts["steps"] = [next(generator), threads(), next(generator)]
    generator.close()
    counts["after steps"] = threads()
    counts["overlapping"] = overlapping()
    with threadpool_limits(2):
        counts["caller's limit"] = [call(), threads()]
    counts["at the end"] = threads()
    print(json.dumps(counts))


if __name__ == "__main__":
    main()
