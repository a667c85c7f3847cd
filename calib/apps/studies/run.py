"""Runs the missing trials of a study: tasks are sent to workers, and rows are stored as they arrive."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from calib.apps.fleet.throughput import Throughput
from calib.apps.studies.conditions import Study
from calib.apps.studies.store import RowStore
from calib.apps.studies.trial import Trials, grouped, run_trials
from calib.errors import TaskLost
from calib.toolkit.torque_models import method_named
from calib.workers import Workers

# Shortest time between two messages on progress [s].
MESSAGE_INTERVAL = 1.0


@dataclass
class Progress:
    """Progress of a study's command.

    Attributes:
        total: number of trials that this command has to run.
        done: number of trials that have ended.
        failed: number of ended trials without an estimate.
        lost: number of trials whose worker was lost.
        spent: name of a method to the durations [s] of its ended trials.
        remaining_trials: name of a method to the number of its trials that have not ended.
        pace: throughput of each worker.
        began: time at which the command began, by `time.monotonic` [s].
    """

    total: int
    done: int = 0
    failed: int = 0
    lost: int = 0
    spent: dict[str, list[float]] = field(default_factory=dict)
    remaining_trials: Counter = field(default_factory=Counter)
    pace: Throughput = field(default_factory=Throughput)
    began: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.began

    @property
    def remaining(self) -> float:
        """Estimated remaining time [s], from each method's mean duration and the number of parallel trials; or NaN."""
        if not self.spent or self.seconds <= 0:
            return float("nan")
        mean_seconds = {name: sum(seconds) / len(seconds) for name, seconds in self.spent.items()}
        worked = sum(sum(seconds) for seconds in self.spent.values())
        mean = worked / max(self.done, 1)
        to_work = 0.0
        for name, count in self.remaining_trials.items():
            to_work += count * mean_seconds.get(name, mean)
        return to_work * self.seconds / max(worked, 1e-9)

    def __str__(self) -> str:
        rate = 60 * self.done / max(self.seconds, 1e-9)
        message = f"{self.done} of {self.total} trials, {rate:.0f} a minute"
        if self.failed:
            message += f", {self.failed} without an estimate"
        if self.lost:
            message += f", {self.lost} lost"
        remaining = self.remaining
        if not math.isnan(remaining) and self.total != self.done:
            message += f"; {span(remaining)} to go"
        return message


def span(seconds: float) -> str:
    """Return a duration `seconds` [s] as text, such as 40 s, 12 min, 3.1 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def _missing(study: Study, store: RowStore) -> Iterator[Trials]:
    """Yield the tasks whose rows are missing in the store, data set by data set over all conditions.

    Methods without start values run once per data set, the others once for each start value.

    Args:
        study: the study.
        store: the store of the study's rows.
    """
    data_sets = 0
    for runs in study.runs:
        data_sets = max(data_sets, *runs.values(), 0)
    for number in range(data_sets):
        for condition, runs, first in zip(study.conditions, study.runs, study.seeds):
            digest = condition.digest
            methods = [method_named(name) for name, count in runs.items() if number < count]
            for guess in range(condition.guesses):
                seed = (first + number) * condition.guesses + guess
                missing = []
                for method in methods:
                    runs_here = method.takes_start or guess == 0
                    if runs_here and not store.holds((digest, method.name, seed)):
                        missing.append(method.name)
                yield from grouped(condition, missing, seed)


def run(study: Study, store: RowStore, workers: Workers, say: Callable[[Progress], None]) -> Progress:
    """Run the missing trials of a study and return the progress; each row is stored as soon as it arrives.

    Args:
        study: the study.
        store: the store of the study's rows.
        workers: workers that run the tasks.
        say: called with the progress at intervals.

    Raises:
        CalibError: rows cannot be written, or the workers are lost.
    """
    tasks = list(_missing(study, store))
    progress = Progress(sum(len(task.methods) for task in tasks))
    for task in tasks:
        progress.remaining_trials.update(task.methods)
    last_message = 0.0
    for number, rows in progress.pace.completed(workers, run_trials, tasks):
        methods = tasks[number].methods
        progress.remaining_trials.subtract(methods)
        if isinstance(rows, TaskLost):
            progress.lost += len(methods)
        else:
            store.append(rows)
            progress.done += len(rows)
            for row in rows:
                progress.failed += not row.found
                if math.isnan(row.seconds):
                    seconds = 0.0
                else:
                    seconds = row.seconds
                progress.spent.setdefault(row.method, []).append(seconds)
        if time.monotonic() - last_message > MESSAGE_INTERVAL:
            last_message = time.monotonic()
            say(progress)
    say(progress)
    return progress
