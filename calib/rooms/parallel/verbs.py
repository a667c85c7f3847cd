"""The verbs of parallel robots, as `calib.procedure.robot_kinds.stage_of` finds them."""

from calib.procedure.dynamic_stage.folder import check_identification_target
from calib.procedure.robot_kinds import Stage
from calib.rooms.parallel.excite import ParallelExcitation, excite_parallel
from calib.rooms.parallel.identification import assess, identify_parallel
from calib.rooms.parallel.loop_fit import ParallelFit, fit_parallel
from calib.rooms.parallel.plan import ParallelPlan, plan_parallel

STAGES = {
    "parallel robot": {
        "fit": Stage(fit_parallel, ParallelFit.folder.check),
        "identify": Stage(identify_parallel, check_identification_target, assess),
        "excite": Stage(excite_parallel, ParallelExcitation.folder.check),
        "plan": Stage(plan_parallel, ParallelPlan.folder.check),
    }
}
