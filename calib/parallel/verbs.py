"""Commands of parallel robots, for `calib.procedure.robot_kinds.stage_of`, and their output files.

``robot.toml`` comes first: each folder is a robot to the next command, with ``chain_covariance.csv``, what a fit knows
of its loops' constants (choices of frames have none), so that the dynamics' sigmas contain the geometry's share.
identify: ``dynamics.json`` (values of all parameters, base expressions, ``preload``: mean torque of redundant actuators
that does no work, see `calib explain preload`); the others are those of a serial arm (``calib formats identified``).
fit: ``estimate.csv`` (changes of the loops' constants), ``covariance.csv``, ``residuals.csv`` (a row per pose:
readings, measured coordinates, errors of the calibrated and of the nominal robot), ``metrics.json``, certificate and
report with figures as a serial arm's. excite:
``motion.csv`` (time, platform coordinates, and position, speed, torque of each actuator), ``trajectory.toml`` (the
actuators' positions as Fourier series, for `calib recall`), ``metrics.json``, figures, and with --after
``prediction.csv``. plan: the same without series. `calib view` shows each of these folders.
"""

from calib.parallel.excite import check_motion_target, excite_parallel
from calib.parallel.export import check_export_target, export_parallel
from calib.parallel.identification import assess, identify_parallel
from calib.parallel.loop_fit import check_fit_target, fit_parallel
from calib.parallel.plan import plan_parallel
from calib.parallel.view import picture
from calib.procedure.dynamic_stage.folder import check_identification_target
from calib.procedure.robot_kinds import CommandStage

STAGES = {
    "fit": CommandStage(fit_parallel, check_fit_target),
    "identify": CommandStage(identify_parallel, check_identification_target, assess),
    "excite": CommandStage(excite_parallel, check_motion_target),
    "plan": CommandStage(plan_parallel, check_motion_target),
    "export": CommandStage(export_parallel, check_export_target),
    "view": CommandStage(picture, check_motion_target),
}
