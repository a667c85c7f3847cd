"""Sessions: a guided procedure in a folder, with its steps, the files for which they wait, and their findings."""

from calib.identification.settings import Payload
from calib.procedure.answers import Answers, CertificateSection
from calib.procedure.session.certificate import pages as certificate_pages
from calib.procedure.session.commands import COLOURS, asks, go_on, measured_columns, new_session, recorded_columns
from calib.procedure.session.drift import Trend, noise_of_difference, repeats, trends
from calib.procedure.session.dynamics_steps import check_recording, designed_motions, next_round, options_of
from calib.procedure.session.folder import (
    BROUGHT,
    LOGS,
    MARK,
    POSES,
    ROUND,
    SETTINGS,
    UNSEEN,
    WAYS,
    Say,
    Session,
    locked,
    open_session,
    read_state,
)
from calib.procedure.session.geometry_steps import chain_of, clear_staging, notes_on, read_measured
from calib.procedure.session.questions import INSTRUMENTS, QUESTIONS, Question, stated_payloads, with_answer
from calib.procedure.session.questions import checked as checked_answers
from calib.procedure.session.recording_names import labels_in, log_name
from calib.procedure.session.session_results import folders_of, position_errors, torque_error
from calib.procedure.session.settings import read_settings
from calib.procedure.session.steps import DONE, KEPT, WAITING, run_next, steps_of
from calib.procedure.session.steps import State as StepState
from calib.procedure.session.steps import find as find_step
from calib.procedure.session.steps import states as step_states

__all__ = [
    "BROUGHT",
    "COLOURS",
    "DONE",
    "INSTRUMENTS",
    "KEPT",
    "LOGS",
    "MARK",
    "POSES",
    "QUESTIONS",
    "ROUND",
    "SETTINGS",
    "UNSEEN",
    "WAITING",
    "WAYS",
    "Answers",
    "CertificateSection",
    "Payload",
    "Question",
    "Say",
    "Session",
    "StepState",
    "Trend",
    "asks",
    "certificate_pages",
    "chain_of",
    "check_recording",
    "checked_answers",
    "clear_staging",
    "designed_motions",
    "find_step",
    "folders_of",
    "go_on",
    "labels_in",
    "locked",
    "log_name",
    "measured_columns",
    "new_session",
    "next_round",
    "noise_of_difference",
    "notes_on",
    "open_session",
    "options_of",
    "position_errors",
    "read_measured",
    "read_settings",
    "read_state",
    "recorded_columns",
    "repeats",
    "run_next",
    "stated_payloads",
    "step_states",
    "steps_of",
    "torque_error",
    "trends",
    "with_answer",
]
