"""Drive gains that convert currents to torques: from the options or the file, or identified with a known payload."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.recordings.recording import parse_cut
from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.data.signals.motion import Motion, make_motion
from calib.dynamics.bodies import STANDARD
from calib.errors import UsageError
from calib.extensions import Point
from calib.identification.gains import DriveGains, identify_gains, identify_relative_gains
from calib.identification.identify import chain_states, common_decimator, find_base
from calib.identification.identify_options import FileSettings, GainPair, IdentifyOptions
from calib.identification.prior import first_fit
from calib.identification.rows import Case, make_case, observe, pool, triangulate, with_blocks
from calib.identification.settings import IdentificationSettings, make_model
from calib.robot.chain import Chain
from calib.units import TORQUE, without_gains

Gains = Callable[[Any, Sequence[Case], IdentificationSettings, Mapping[str, float], int | None], DriveGains]
DRIVE_GAINS: Point[Gains] = Point("drive_gains", "gains of a robot that is no serial arm")


@dataclass(frozen=True, eq=False)
class FoundGains:
    """Drive gains that convert currents to torques.

    Attributes:
        options: the options, with payload parameters identified together with the gains.
        gains: (n,) for recordings without stated gains; None if not needed.
        found: the identification of gains; None without one.
        unit: of the torques.
        notes: remarks for the user.
    """

    options: IdentifyOptions
    gains: np.ndarray | None
    found: DriveGains | None
    unit: str
    notes: tuple[str, ...]

    @property
    def own(self) -> tuple[int, ...]:
        """Joints (from 0) without an identified gain, whose torques stay in amperes."""
        return () if self.found is None else self.found.own

    def for_motion(self, motion: Motion, own: FileSettings) -> np.ndarray | None:
        """Return the gains (n,) for a motion, from options, identification or file; None for torques."""
        if own.gains is not None:
            if len(own.gains) not in (1, motion.n):
                raise UsageError(f"gains: {len(own.gains)} values for {motion.n} joints ({motion.file})")
            return np.broadcast_to(np.array(own.gains), (motion.n,))
        if motion.kind != "current":
            return None
        return self.gains if self.gains is not None else motion.drive_gain


def find_gains(
    chain: Chain,
    options: IdentifyOptions,
    motions: Mapping[str, Motion],
    training: Sequence[str],
    say: Callable[[str], None],
) -> FoundGains:
    """Return the drive gains that convert the currents of `motions` (path → motion) to torques."""
    currents = [path for path, motion in motions.items() if motion.kind == "current"]
    stated = [path for path in currents if options.file_settings(path).gains is not None]
    if options.gain_pair is not None:
        say("drive gains")
        return _from_pair(chain, options, options.gain_pair, motions)
    bare = [path for path in currents if path not in stated and motions[path].drive_gain is None]
    if not bare:
        return FoundGains(options, None, None, TORQUE, ())
    if len(bare) < len(motions):
        rest = [path for path in motions if path not in bare]
        raise UsageError(
            f"{bare[0]} holds currents without gains, {rest[0]} torques (or currents with gains): one model cannot "
            "use both A and N m; state gains for all of them"
        )
    say("relative drive gains")
    return _relative(chain, options, [(path, motions[path]) for path in training if path in bare])


def _from_pair(chain: Chain, options: IdentifyOptions, pair: GainPair, motions: Mapping[str, Motion]) -> FoundGains:
    settings = options.settings
    known = {f"M{label}": own.mass for label, own in settings.payloads.items() if own.mass is not None}
    for label, own in settings.payloads.items():
        if own.com is not None and own.mass is not None:
            known |= {f"M{axis}{label}": own.mass * c for axis, c in zip("XYZ", own.com)}
    if not known:
        raise UsageError(f"{options.source}: gain_identification needs a [payload.<label>] with its mass")
    cases = [
        _case(name, chain, options, motions, carried)
        for names, carried in ((pair.unloaded, ()), (pair.loaded, tuple(settings.payloads)))
        for name in names
    ]
    found = _identify(chain, cases, settings, known, None)
    values = dict(zip(found.names, found.values))
    loads = {label: tuple(float(values.get(name + label, 0.0)) for name in STANDARD) for label in settings.payloads}
    told = ", ".join(f"{gain:.4g} ± {sigma:.2g}" for gain, sigma in zip(found.gains, found.sigma))
    files = ", ".join(Path(parse_cut(name)[0]).name for name in (*pair.unloaded, *pair.loaded))
    notes = [
        f"drive gains from {files} ({found.scale}): {told}",
        f"gains and payload are estimated from {files}: no independent validation data; no σ of a parameter contains "
        "that of the gains",
    ]
    notes += _unsure(found)
    chosen = replace(options, settings=replace(settings, payload_values=loads))
    return FoundGains(chosen, found.gains, found, TORQUE, tuple(notes))


def _relative(chain: Chain, options: IdentifyOptions, currents: Sequence[tuple[str, Motion]]) -> FoundGains:
    """Return the drive gains relative to the joint with the largest current; all torques are then in its amperes."""
    if not currents:
        return FoundGains(options, None, None, "A", ("drive gains are unknown: torques are currents [A]",))
    cases = [make_case(path, motion, carried=options.file_settings(path).payload) for path, motion in currents]
    squares = sum(np.sum(np.asarray(case.target) ** 2, axis=0) for case in cases)
    reference = int(np.argmax(squares))
    found = _identify(chain, cases, options.settings, {}, reference)
    told = ", ".join(
        "unknown" if j in found.own else "1" if j == reference else f"{gain:.4g} ± {sigma:.2g}"
        for j, (gain, sigma) in enumerate(zip(found.gains, found.sigma))
    )
    note = (
        f"torques are {without_gains(f'A of joint {reference + 1}')}; gains relative to it {told}; for N m give gains, "
        "or [gain_identification] with a payload of known mass"
    )
    apart = [f"joint {j + 1}" for j in sorted(found.own)]
    own = (
        f"this motion does not identify the gain of {', '.join(apart)}: torques of such a joint stay in A and "
        "are omitted from totals; record richer motion, or give the gain",
    )
    notes = (note, *(own if apart else ()), *_unsure(found))
    options = replace(options, settings=replace(options.settings, apart=tuple(found.own)))
    return FoundGains(options, found.gains, found, f"A of joint {reference + 1}", notes)


def _identify(
    chain: Chain,
    cases: Sequence[Case],
    settings: IdentificationSettings,
    known: Mapping[str, float],
    reference: int | None,
) -> DriveGains:
    if not isinstance(chain, Chain):
        return DRIVE_GAINS.one()(chain, cases, settings, known, reference)
    model = make_model(chain, settings)
    base = find_base(model, cases, chain_states(chain, model, settings.seed))
    missing = [name for name in known if name not in [model.names[k] for k in base.kept]]
    if missing:
        raise UsageError(f"'{missing[0]}' is not separately identifiable here; was the payload attached?")
    decimator = common_decimator(cases, settings)
    rows = with_blocks([observe(model, base.kept, case, decimator) for case in cases], settings.folds)
    tau = first_fit(rows)[1]
    if reference is not None:
        return identify_relative_gains(triangulate(rows), chain.n, tau, reference)
    return identify_gains(pool(triangulate(rows), chain.n), known, tau)


def _case(
    name: str, chain: Chain, options: IdentifyOptions, motions: Mapping[str, Motion], carried: tuple[str, ...]
) -> Case:
    """Return the case of currents, from a given recording or from a file in the folder of the options file."""
    path = next((path for path in motions if path == name or Path(parse_cut(path)[0]).name == parse_cut(name)[0]), None)
    if path is not None:
        return make_case(name, motions[path], carried=carried)
    beside = Path(options.source).parent / name if options.source else Path(name)
    where = str(beside) if Path(parse_cut(str(beside))[0]).exists() else name
    if not Path(parse_cut(where)[0]).exists():
        raise UsageError(f"{options.source}: gain_identification names {name}, neither a given recording nor a file")
    own = options.file_settings(where)
    motion = make_motion(read_recording(where, Joints(chain.joint_names), own.recording), own.filter)
    return make_case(name, motion, carried=carried)


def _unsure(found: DriveGains) -> list[str]:
    unsure = [j for j in range(len(found.gains)) if found.sigma[j] > 0.1 * abs(found.gains[j])]
    if not unsure:
        return []
    shown = ", ".join(f"joint {j + 1} ({100 * found.sigma[j] / abs(found.gains[j]):.0f} %)" for j in unsure)
    return [f"these runs identify some gains poorly:  {shown}"]
