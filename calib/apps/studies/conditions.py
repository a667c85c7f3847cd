"""The study file: compared methods, simulated experiments, and number of runs.

TOML; SI units. Every combination of robot, motion, rate, noise, decimation, cutoff and mismatch is a condition::

    name = "small"                   # of the study, and of its folder's conditions
    about = "what it is for"         # a sentence for lists
    robot = ["tx40", "rv2sq"]        # those two: their true inertias, friction and controller are known
    motion = "designed"              # by calib excite; default random: the best of 20 random Fourier series
    rate = [200, 50]                 # of the log [Hz]; default 0: the toolbox's, 1000 (tx40) and 140 (rv2sq)
    decimation = [1, 4]              # one sample in so many is kept, behind the parallel low-pass
    cutoff = 50.0                    # of the positions' zero-phase Butterworth filter [Hz], or a list; 0: none to speak
                                     # of (0.8 of the Nyquist frequency)
    mismatch = "none"                # or a list: geometry (the robot is off its drawing, 0.9 mm, 1.5 mrad and
                                     # 9 mrad of joint offset rms), calibrated (the same, its geometry fitted first to
                                     # 40 measured poses), controller (gains believed 30 % off), friction (a Stribeck
                                     # peak of half Fc that the model lacks), payload (1 kg nobody was told of), clock
                                     # (torques logged 2 ms late)
    methods = ["wls", "iv"]          # or "all": calib study --list-methods
    runs = 20                        # data sets per condition, each with noise of its own
    runs_loop = 10                   # of methods that simulate the closed loop; default: runs
    runs_filter = 5                  # of methods that simulate the robot alone (Kalman filters); default: runs
    runs_of = { iv = 10 }            # for single methods
    seed = 0                         # number of the first data set
    duration = 10.0                  # of the motion [s]
    guess = 0.15                     # relative error of what cloe, clie, Kalman filters and networks start from
    guesses = 25                     # of these, the same for every data set: such methods run once from each; default 1
    resimulated = 3                  # data sets whose estimate is simulated once more, for the survey's position error
    [[noise]]                        # at least one
    name = "1"                       # ends the names of conditions
    sigma_q = "1e-4 deg"             # of every encoder, in the loop
    sigma_tau = 0.05                 # of the logged torque [N m]

In its folder summary.csv holds, of every figure of a method on a condition, the median over runs and, as ``_lower`` and
``_upper``, the quartiles: each the nearest of the runs' own values, not interpolated between two.

The same data set serves all methods. The 15 conditions of Leboutet et al. (2021), MCS-TX40-1-1 to MCS-RV2SQ-1-5, and
others come with the toolkit: ``calib study --list``.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Annotated

from annotated_types import MinLen

from calib.config import parse, read_toml, strict
from calib.config_types import Name, OneOf, Real, Spread, Text, Whole
from calib.errors import UsageError, require, suggestion
from calib.toolkit.torque_models import METHODS, method_named

ROBOTS = ("tx40", "rv2sq")
MOTIONS = ("random", "designed")
MISMATCHES = ("none", "geometry", "calibrated", "controller", "friction", "payload", "clock")
LIBRARY = Path(str(resources.files("calib.apps.studies").joinpath("library")))
# Raised whenever the trials of all methods change: rows with a lower number do not count. Where one method changes,
# its `calib.identification.methods.method.Method.version` is raised.
TRIAL = 1

# Values of fields that came later: they are no part of a digest, so that rows from before these fields count.
_LATER = {"motion": "random", "rate": 0.0, "guesses": 1}
_Few = Spread(words="a value, or a list of them")
Robots = Annotated[
    tuple[Annotated[str, OneOf(ROBOTS, "simulated robots only; for recordings: calib compare")], ...], _Few
]
Wholes = Annotated[tuple[Annotated[int, Whole(1, 100)], ...], _Few]
Motions = Annotated[tuple[Annotated[str, OneOf(MOTIONS)], ...], _Few]
Rates = Annotated[tuple[Annotated[float, Real(least=0, most=5000)], ...], _Few]
Cutoffs = Annotated[tuple[Annotated[float, Real(least=0, words="0 or more, Hz without a unit")], ...], _Few]
Mismatches = Annotated[tuple[Annotated[str, OneOf(MISMATCHES)], ...], _Few]
Methods = Annotated[tuple[Name, ...], _Few]
Count = Annotated[int, Whole(0, 1_000_000)]


@strict
@dataclass(frozen=True)
class Noise:
    """Named noise levels: σ of the encoders [rad] and of the logged torques [N m]."""

    name: Name
    sigma_q: Annotated[float, Real(least=0, most=0.1, unit="rad", quantity="angle")]
    sigma_tau: Annotated[float, Real(least=0, quantity="torque")]


@strict
@dataclass(frozen=True)
class StudyFile:
    """Content of a study file; one field per key."""

    name: Name
    noise: Annotated[tuple[Noise, ...], MinLen(1)]
    robot: Robots
    about: Text = ""
    motion: Motions = ("random",)
    rate: Rates = (0.0,)
    decimation: Wholes = (1,)
    cutoff: Cutoffs = (50.0,)
    mismatch: Mismatches = ("none",)
    methods: Methods = ("all",)
    runs: Count = 20
    runs_loop: Count | None = None
    runs_filter: Count | None = None
    runs_of: Mapping[str, Count] = field(default_factory=dict)
    seed: Count = 0
    duration: Annotated[float, Real(least=2.0, most=600.0, unit="s")] = 10.0
    guess: Annotated[float, Real(least=0, most=10.0)] = 0.15
    guesses: Annotated[int, Whole(1, 1000)] = 1
    resimulated: Count = 3


@dataclass(frozen=True)
class Condition:
    """One simulated experiment, without the seed of its noise.

    Attributes:
        name: name in tables; not part of the key.
        robot: one of `ROBOTS`.
        sigma_q, sigma_tau: σ of the encoders in the loop [rad], and of the logged torque [N m].
        decimation: factor of the parallel decimation.
        cutoff: cut-off frequency of the filter of the positions [Hz]; 0 for none.
        mismatch: the wrong assumption of the methods, one of `MISMATCHES`.
        duration: duration of the motion [s].
        guess: relative error of the start parameters, for methods that need start parameters.
        resimulated: number of data sets for which the survey's position error is computed.
        motion: one of `MOTIONS`, or the folder of a motion by `calib excite`.
        rate: sampling rate of the log [Hz]; 0 for the robot's own rate.
        guesses: number of start values per data set; trial k uses data set k // guesses and start value k % guesses.
    """

    name: str
    robot: str
    sigma_q: float
    sigma_tau: float
    decimation: int = 1
    cutoff: float = 50.0
    mismatch: str = "none"
    duration: float = 10.0
    guess: float = 0.15
    resimulated: int = 3
    motion: str = "random"
    rate: float = 0.0
    guesses: int = 1

    @property
    def digest(self) -> str:
        """Key of the condition's rows in the store; conditions that differ only in name share it."""
        content = asdict(self)
        del content["name"], content["resimulated"]
        for key, value in _LATER.items():
            if content[key] == value:
                del content[key]
        text = json.dumps([TRIAL, content], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Study:
    """Conditions of a study, and the number of runs of each method on each condition.

    Attributes:
        name, about: name and description of the study.
        conditions: the conditions, with distinct names.
        runs: one mapping per condition: name of a method to number of data sets.
        seeds: for each condition, the number of the first data set.
    """

    name: str
    about: str
    conditions: tuple[Condition, ...]
    runs: tuple[Mapping[str, int], ...]
    seeds: tuple[int, ...]

    @property
    def methods(self) -> tuple[str, ...]:
        """All methods of the study, in the registry's order."""
        names = set().union(*self.runs)
        return tuple(name for name in METHODS if name in names)


def shipped() -> dict[str, Path]:
    """Return the study files shipped with the toolkit, by name."""
    return {path.stem: path for path in sorted(LIBRARY.glob("*.toml"))}


def read_study(files: Sequence[str | Path], methods: Sequence[str] | None = None, runs: int | None = None) -> Study:
    """Return the study that one or several files define together.

    Args:
        files: paths, names of shipped studies, or patterns of these names (``MCS-*``).
        methods, runs: replace the methods and the number of runs in the files; None: as in the files.

    Raises:
        UsageError: an invalid study file, an unknown method, or two conditions of one name.
    """
    for name in methods or ():
        method_named(name)
    study_files = [_parse(path) for path in _paths(files)]
    conditions: list[Condition] = []
    counts: list[Mapping[str, int]] = []
    seeds: list[int] = []
    for study in study_files:
        for condition in _expanded(study):
            conditions.append(condition)
            counts.append(_counts(study, methods, runs))
            seeds.append(study.seed)
    names = [condition.name for condition in conditions]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(
                f"two conditions are named '{name}': state each value once, and give noises (and studies of "
                "several files) different names"
            )
    _check_cutoffs(conditions)
    name = study_files[0].name
    about = study_files[0].about
    if len(study_files) > 1:
        name = f"{len(study_files)} studies"
        about = ", ".join(study.name for study in study_files)
    return Study(name, about, tuple(conditions), tuple(counts), tuple(seeds))


def _check_cutoffs(conditions: Sequence[Condition]) -> None:
    """Raise UsageError for a condition whose cut-off frequency is at or above half the log's sampling rate."""
    from calib.toolkit.simulations import known_truth  # slow to load

    for condition in conditions:
        rate = condition.rate or float(known_truth(condition.robot)["control"]["sampling"])
        limit = 0.5 * rate
        if condition.cutoff >= limit:
            raise UsageError(
                f"{condition.name}: cutoff: expected less than {limit:g} Hz, half the rate of the {condition.robot}'s "
                f"log, found {condition.cutoff:g}; 0 is unfiltered"
            )


def _paths(files: Sequence[str | Path]) -> list[Path]:
    """Return the paths of study files, each once, from paths, names of shipped studies, and patterns of names."""
    library = shipped()
    paths: list[Path] = []
    for text in map(str, files):
        if Path(text).exists() or text.endswith(".toml"):
            paths.append(Path(text))
            continue
        matches = [path for name, path in library.items() if fnmatchcase(name.lower(), text.lower())]
        message = f"no study '{text}'{suggestion(text, library)}: give a file, or a name of calib study --list"
        require(matches, message, UsageError)
        paths += matches
    require(paths, "no study given: name a file, or a study of calib study --list", UsageError)
    return list(dict.fromkeys(paths))


def _parse(path: Path) -> StudyFile:
    """Return the content of the study file at `path`.

    Raises:
        UsageError: a file that `calib.config.parse` refuses, or an unknown method.
    """
    study = parse(StudyFile, read_toml(path), str(path))
    for name in study.methods:
        if name != "all":
            _check_method(path, "methods", name)
    for name in study.runs_of:
        _check_method(path, "runs_of", name)
    return study


def _check_method(path: Path, key: str, name: str) -> None:
    advice = f"{suggestion(name, METHODS)}; calib study --list-methods"
    require(name in METHODS, f"{path}: {key}: there is no method '{name}'{advice}", UsageError)


def _expanded(study: StudyFile) -> list[Condition]:
    """Return the conditions of a study file: all combinations of its values, each with a name."""
    axes = (study.robot, study.motion, study.rate, study.noise, study.decimation, study.cutoff, study.mismatch)
    conditions = []
    for robot, motion, rate, noise, decimation, cutoff, mismatch in product(*axes):
        values = (robot, motion, _rate_name(rate), noise.name, f"r{decimation}", _cutoff_name(cutoff), mismatch)
        # The name says the values of what varies.
        parts = [value for value, axis in zip(values, axes) if len(axis) > 1]
        condition = Condition(
            name="-".join([study.name, *parts]),
            robot=robot,
            sigma_q=noise.sigma_q,
            sigma_tau=noise.sigma_tau,
            decimation=decimation,
            cutoff=cutoff,
            mismatch=mismatch,
            duration=study.duration,
            guess=study.guess,
            resimulated=study.resimulated,
            motion=motion,
            rate=rate,
            guesses=study.guesses,
        )
        conditions.append(condition)
    return conditions


def _rate_name(rate: float) -> str:
    if rate:
        return f"{rate:g}Hz"
    return "own"


def _cutoff_name(cutoff: float) -> str:
    if cutoff:
        return f"{cutoff:g}Hz"
    return "unfiltered"


def _counts(study: StudyFile, methods: Sequence[str] | None, runs: int | None) -> dict[str, int]:
    """Return the number of runs of each method, by name.

    Args:
        study: the study file.
        methods, runs: replace the methods and the number of runs in the file; None: as in the file.
    """
    if "all" in study.methods:
        names = list(METHODS)
    else:
        names = list(study.methods)
    if methods is not None:
        names = list(methods)
    if runs is not None:
        return dict.fromkeys(names, runs)
    return {name: _runs_of(study, name) for name in names}


def _runs_of(study: StudyFile, name: str) -> int:
    """Return the number of runs that a study file sets for a method, or for methods of its kind.

    Args:
        study: the study file.
        name: name of the method.
    """
    method = METHODS[name]
    runs = None
    if method.needs_controller:
        runs = study.runs_loop
    elif method.needs_simulation:
        runs = study.runs_filter
    if runs is None:
        runs = study.runs
    return study.runs_of.get(name, runs)
