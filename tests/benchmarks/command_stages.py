"""Processor time of whole commands by stage, beside an earlier state of the code.

    git worktree add ../before 3d1f552
    python tests/benchmarks/command_stages.py --beside ../before --page docs/growth.md

Each command runs in a process of its own, the two states in turn, on one thread; of its runs the one with the least
processor time counts. Stages are exclusive: what is imported while a figure is drawn counts as imports. Byte code is
written, as where the package is installed, so that only the first run compiles modules.
"""

import argparse
import builtins
import importlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from growth_work import UNIT, made

from calib.files import write

TOP = Path(__file__).parents[2]
STAGES = {
    "reading": ("kinematic_stage.inputs:gather", "dynamic_stage.inputs:gather"),
    "calculation": ("kinematic_stage.fit:run", "dynamic_stage.identify:run"),
    "figures": ("report.figures.drawing:png", "report.figures.svg:svg", "report.figures.figure_data:text"),
    "writing": ("kinematic_stage.folder:write_folder", "dynamic_stage.folder:write_folder"),
}
COLUMNS = ("imports", *STAGES, "other", "all", "MB")
COMMANDS: dict[str, Callable[[], list[str]]] = {
    "calib fit, 800 poses": lambda: made("command_fit", 800).words,
    "calib fit, 10,000 poses": lambda: made("command_fit", 10_000).words,
    "calib identify, 30 s": lambda: made("command_identify", 30_000).words,
    "calib identify, 10 min": lambda: made("command_identify", 600_000).words,
    "calib select, 40 of 2,000": lambda: made("command_select", 2_000).words,
    "calib excite, 10 s": lambda: ["excite", "tx40", "--period", "10", "--out", "motion"],
    "calib demo": lambda: ["demo", "--out", "demo"],
}


class Clock:
    """Processor seconds of stages; the innermost stage counts."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {"other": 0.0}
        self.stack, self.since = ["other"], 0.0

    def _count(self) -> None:
        now = time.process_time()
        self.spent[self.stack[-1]] = self.spent.get(self.stack[-1], 0.0) + now - self.since
        self.since = now

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Count what happens within as the stage's."""
        self._count()
        self.stack.append(stage)
        try:
            yield
        finally:
            self._count()
            self.stack.pop()

    def around(self, call: Callable[..., Any], stage: str) -> Callable[..., Any]:
        """Return a function whose time is the stage's."""

        def timed(*given: Any, **options: Any) -> Any:
            with self.of(stage):
                return call(*given, **options)

        return timed


def staged(words: Sequence[str]) -> None:
    """Run a command in this process, then print its seconds by stage and its peak memory [MB] as JSON."""
    clock = Clock()
    timed_import = clock.around(builtins.__import__, "imports")
    waiting = {f"calib.procedure.{one}": stage for stage, names in STAGES.items() for one in names}

    def imported(name: str, *given: Any, **options: Any) -> Any:
        load = plain_import if clock.stack[-1] == "imports" else timed_import
        found = load(name, *given, **options)
        for one in [one for one in waiting if one.partition(":")[0] in sys.modules]:
            place, _, function = one.partition(":")
            if hasattr(module := sys.modules[place], function):
                setattr(module, function, clock.around(getattr(module, function), waiting.pop(one)))
        return found

    plain_import, builtins.__import__ = builtins.__import__, imported
    clock.spent["imports"] = time.process_time()
    clock.since = time.process_time()
    try:
        with clock.of("imports"):
            cli = importlib.import_module("calib.cli")
        cli.main(list(words))
    except SystemExit as end:
        if end.code not in (0, 1, None):
            raise
    with clock.of("other"):
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / UNIT
    print(json.dumps(clock.spent | {"all": sum(clock.spent.values()), "MB": memory}), file=sys.stderr)


def measured(words: Sequence[str], tree: Path) -> dict[str, float]:
    """Return the seconds of a command's stages and its peak memory [MB], in a process of a state of the code."""
    with tempfile.TemporaryDirectory() as folder:
        for name in os.listdir():
            os.symlink(Path(name).absolute(), Path(folder, name))
        places = {
            "PYTHONPATH": os.pathsep.join([str(tree), str(TOP)]),
            "OMP_NUM_THREADS": "1",
            "PYTHONDONTWRITEBYTECODE": "",
            "PYTHONPYCACHEPREFIX": str(Path(tempfile.gettempdir(), "byte_code")),
        }
        done = subprocess.run(
            [sys.executable, __file__, "--run", *words], capture_output=True, text=True, cwd=folder,
            env=os.environ | places,
        )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"calib {' '.join(words)} in {tree}:\n{done.stderr}")
    return json.loads(done.stderr.splitlines()[-1])


def table(rows: Sequence[tuple[str, dict[str, float]]]) -> str:
    """Return the table of stages: a row per command and state of the code."""
    lines = [f"| processor seconds | {' | '.join(COLUMNS)} |", f"|---|{'---:|' * len(COLUMNS)}"]
    for name, found in rows:
        cells = [f"{found.get(column, 0.0):.{0 if column == 'MB' else 2}f}" for column in COLUMNS]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    if sys.argv[1:2] == ["--run"]:
        return staged(sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--beside", type=Path, help="folder with an earlier state of the code")
    parser.add_argument("--only", nargs="+", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--page", type=Path, help="write the table into this page, between <!-- stages --> and end")
    given = parser.parse_args()
    trees = ([("before", given.beside.absolute())] if given.beside else []) + [("now", TOP)]
    page, rows = given.page and given.page.absolute(), list[tuple[str, dict[str, float]]]()
    for name in given.only:
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            words = COMMANDS[name]()
            runs = [[measured(words, tree) for _, tree in trees] for _ in range(given.runs)]
            os.chdir(TOP)
        for (state, _), found in zip(trees, zip(*runs)):
            rows.append((f"{name}, {state}", min(found, key=lambda one: one["all"])))
            print(rows[-1][0], *(f"{key} {rows[-1][1].get(key, 0.0):.2f}" for key in COLUMNS), flush=True)
    print(f"\n{table(rows)}")
    if page:
        block = f"<!-- stages -->\n{table(rows)}\n<!-- end -->"
        text, count = re.subn(r"<!-- stages -->.*?<!-- end -->", lambda _: block, page.read_text(), flags=re.DOTALL)
        if count != 1:
            raise SystemExit(f"{page} has {count} places <!-- stages --> … <!-- end -->; give it one")
        write(page, text)


if __name__ == "__main__":
    main()
