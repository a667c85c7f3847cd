"""Running the missing trials of a study: tasks go to workers, rows to the store as they arrive."""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from calib.errors import TaskLost
from calib.identification.registry import method_named
from calib.rooms.fleet.throughput import Throughput
from calib.rooms.studies.conditions import Study
from calib.rooms.studies.store import RowStore
from calib.rooms.studies.trial import Trials, grouped, run_trials
from calib.workers import Workers


@dataclass
class Progress:
    """Progress of a study's command.

    Attributes:
        wanted: trials that this command has to run.
        done, failed: that have ended; of these without an estimate.
        lost: that no worker brought back.
        seconds: since it began.
        pace: of each worker.
    """

    wanted: int
    done: int = 0
    failed: int = 0
    lost: int = 0
    spent: dict[str, list[float]] = field(default_factory=dict)
    left: Counter = field(default_factory=Counter)
    pace: Throughput = field(default_factory=Throughput)
    began: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.began

    @property
    def remaining(self) -> float:
        """Estimated remaining time [s], from each method's mean time so far and the number of trials in parallel."""
        paces = {name: sum(own) / len(own) for name, own in self.spent.items()}
        if not paces or self.seconds <= 0:
            return float("nan")
        worked = sum(sum(own) for own in self.spent.values())
        mean = worked / max(self.done, 1)
        ahead = sum(count * paces.get(name, mean) for name, count in self.left.items())
        return ahead * self.seconds / max(worked, 1e-9)

    def __str__(self) -> str:
        words = f"{self.done} of {self.wanted} trials, {60 * self.done / max(self.seconds, 1e-9):.0f} a minute"
        words += f", {self.failed} without an estimate" if self.failed else ""
        words += f", {self.lost} lost" if self.lost else ""
        left = self.remaining
        return words if left != left or not self.wanted - self.done else f"{words}; {span(left)} to go"


def span(seconds: float) -> str:
    """Return a duration as text: 40 s, 12 min, 3.1 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _missing(study: Study, store: RowStore) -> Iterator[Trials]:
    """Yield the tasks that have no rows in the store, data set by data set over all conditions.

    Methods that take no start values run once per data set, the others from each guess.
    """
    most = max((max(runs.values(), default=0) for runs in study.runs), default=0)
    for number in range(most):
        for condition, runs, first in zip(study.conditions, study.runs, study.seeds):
            digest, asked = condition.digest, [method_named(name) for name, count in runs.items() if number < count]
            for guess in range(condition.guesses):
                seed = (first + number) * condition.guesses + guess
                own = [one.name for one in asked if one.takes_start or not guess]
                yield from grouped(condition, [name for name in own if not store.holds((digest, name, seed))], seed)


def run(study: Study, store: RowStore, workers: Workers, say: Callable[[Progress], None]) -> Progress:
    """Run the missing trials of a study; each row is stored as soon as it arrives.

    Args:
        say: called with how far it is, now and then.

    Raises:
        CalibError: where rows cannot be kept, or the workers are gone.
    """
    tasks = list(_missing(study, store))
    progress = Progress(sum(len(task.methods) for task in tasks))
    progress.left.update(name for task in tasks for name in task.methods)
    said = 0.0
    word_interval = 1.0  # [s] between two words on progress
    for number, rows in progress.pace.completed(workers, run_trials, tasks):
        methods = tasks[number].methods
        progress.left.subtract(methods)
        if isinstance(rows, TaskLost):
            progress.lost += len(methods)
        else:
            store.append(rows)
            progress.done += len(rows)
            progress.failed += sum(not row.found for row in rows)
            for row in rows:
                progress.spent.setdefault(row.method, []).append(row.seconds if row.seconds == row.seconds else 0.0)
        if time.monotonic() - said > word_interval:
            said = time.monotonic()
            say(progress)
    say(progress)
    return progress
