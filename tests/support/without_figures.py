"""Commands run in this process without figures, which cost more than most of what they show."""

from calib import cli

DRAWING = ("select", "fit", "identify", "excite", "plan", "next", "redo", "demo", "run")


def words(*arguments: object) -> list[str]:
    """Return a command line as text, with --no-plots where the command would draw."""
    line = [str(argument) for argument in arguments]
    bare = ["--no-plots"] if line[0] in DRAWING and not {"--plots", "--no-plots"} & set(line) else []
    return [*line, *bare]


def run(*arguments: object) -> int:
    """Run a command; return its exit code."""
    return cli.run(words(*arguments))
