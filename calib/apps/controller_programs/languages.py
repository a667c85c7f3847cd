"""Tool, user frame and configuration of the poses in a controller's program, as the program says them.

==========  ===========================================================================================================
TP          ``UF : 1, UT : 2, CONFIG : 'N U T, 0, 0, 0'`` of each position; where it says ``F``, the program's only
            ``UFRAME_NUM=``, ``UTOOL_NUM=``. Their numbers are in no program: in ``SYSFRAME.VA`` of a backup
KRL         ``$TOOL =``, ``$BASE =``, ``BAS(#TOOL,1)``, ``BAS(#BASE,2)`` before a motion; ``TOOL_NO``, ``BASE_NO`` of a
            point's FDAT; numbers ``TOOL_DATA[1]={...}`` (``$config.dat``); ``S`` and ``T`` of the point
RAPID       tool and ``\\WObj`` of the moves that use a robtarget; numbers of tooldata and wobjdata; confdata
URScript    ``set_tcp(p[...])`` before the move; poses stand in Base and have no configuration
==========  ===========================================================================================================

Numbers that a program does not have are read of further files (``--frames``): the controller's own, or lines as
`calib deliver` prints them.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from calib.apps.controller_programs.targets import NUMBER, Program, Target, pose_of_values
from calib.errors import UsageError
from calib.toolkit.chains import Controller

# letters before a FANUC's pose in which its UF, UT and CONFIG stand
BLOCK = 400
# letters behind a pose in which its configuration stands
BEHIND = 120


@dataclass(frozen=True)
class Setting:
    """Tool, user frame and configuration that a program uses for one of its poses.

    Attributes:
        tool, user: names of tool and user frame, as keys of `ProgramFrames`; empty where the program names none.
        configuration: the configuration as the program writes it; empty where the program has none.
    """

    tool: str
    user: str
    configuration: str = ""


@dataclass(frozen=True, eq=False)
class ProgramFrames:
    """Tool, user frame and configuration of each pose of a program, and the frames whose numbers are known.

    Attributes:
        settings: one for each pose, in the program's order.
        tools, users: name to pose (4, 4) [m] of tools in the controller's flange, and of user frames in its base.
    """

    settings: tuple[Setting, ...]
    tools: Mapping[str, np.ndarray] = field(default_factory=dict)
    users: Mapping[str, np.ndarray] = field(default_factory=dict)


def frames_in(program: Program, further: Mapping[str, str] | None = None) -> ProgramFrames:
    """Return tool, user frame and configuration of each pose in a program, and the frames whose numbers are known.

    Args:
        program: the program.
        further: file name to text of further files of the controller, which are searched too; None: no such files.

    Raises:
        UsageError: a language whose frames cannot be read, a tool fixed in the cell, or a frame defined twice with
            different numbers.
    """
    language = LANGUAGES.get(program.controller.language)
    if language is None:
        raise UsageError(
            f"{program.path}: frames in programs of {program.controller.title} are not read; give the targets as a CSV"
        )
    blank = language.without_comments(program.text)
    settings = tuple(language.setting(blank, program.targets[k]) for k in program.of("pose"))
    tools: dict[str, np.ndarray] = {}
    users: dict[str, np.ndarray] = {}
    texts = {str(program.path): program.text} | dict(further or {})
    for file, text in texts.items():
        numbers = language.numbers(language.without_comments(text), program.controller)
        for kind, frames in zip((tools, users), numbers):
            for name, pose in frames.items():
                if name in kind and np.abs(kind[name] - pose).max() > 1e-9:
                    raise UsageError(f"{file}: {name} is given twice with different values; remove one")
                kind[name] = pose
    tools |= dict.fromkeys(language.flange, np.eye(4))
    users |= language.base()
    return ProgramFrames(settings, tools, users)


Frames = dict[str, np.ndarray]


@dataclass(frozen=True)
class Language:
    """How a programming language of robot controllers writes frames.

    Attributes:
        comment: characters that begin a comment; empty for a language without comments.
        setting: function of (text without comments, target) that returns the target's setting.
        numbers: function of (text without comments, controller) that returns the tools and the user frames with
            numbers.
        flange, world: names of the all-zero tool, and of the controller's base.
        files: description of the files that contain the numbers; empty for none.
    """

    comment: str
    setting: Callable[[str, Target], Setting]
    numbers: Callable[[str, Controller], tuple[Frames, Frames]]
    flange: tuple[str, ...]
    world: tuple[str, ...]
    files: str

    def base(self) -> Frames:
        """Return the user frames that coincide with the controller's base: name to identity (4, 4)."""
        return dict.fromkeys(self.world, np.eye(4))

    def without_comments(self, text: str) -> str:
        """Return the text with each comment replaced by as many blanks."""
        if not self.comment:
            return text
        return re.sub(f"{self.comment}[^\n]*", lambda match: " " * len(match[0]), text)


def _frame(form: str) -> str:
    """Return the regular expression for a short pattern of a frame.

    Args:
        form: the pattern, in which NUM is a number and a blank is any number of blanks.
    """
    return form.replace(" ", r"\s*").replace("NUM", NUMBER)


def _posed(match: re.Match[str], first: int, controller: Controller, count: int = 6) -> np.ndarray:
    """Return the pose (4, 4) [m] that consecutive groups of a regular expression's match contain.

    Args:
        match: the match.
        first: index of the first group with a number.
        controller: the controller, which determines units and angles.
        count: number of numbers.
    """
    values = [float(match[group]) for group in range(first, first + count)]
    return pose_of_values(controller, np.array([values]))[0]


def _either(pairs: set[tuple[str, str]]) -> tuple[str, str]:
    """Return tool and user frame of the moves that use one target.

    Where moves differ, their names are joined by 'or'; no frame has such a name.

    Args:
        pairs: (tool, user frame) of each move.
    """
    tools = {tool for tool, _ in pairs}
    users = {user for _, user in pairs}
    return " or ".join(sorted(tools)), " or ".join(sorted(users))


# --- FANUC TP

_TP_HEAD = re.compile(r"UF\s*:\s*(\w+)\s*,\s*UT\s*:\s*(\w+)\s*,(?:\s*CONFIG\s*:\s*'([^']*)')?", re.I)
_TP_LINE = re.compile(_frame(r"\b(UTOOL|UFRAME) \[ (\d+) \] : X NUM , Y NUM , Z NUM mm , W NUM , P NUM , R NUM deg"))
_TP_SECTION = re.compile(r"\[\*SYSTEM\*\]\$(MNUTOOL|MNUFRAME)\b(.*?)(?=\[\*SYSTEM\*\]|\Z)", re.S)
_TP_ENTRY = re.compile(
    r"\[1,(\d+)\]\s*=\s*(?:Group:[^\n]*\n)?\s*" + _frame("X : NUM Y : NUM Z : NUM W : NUM P : NUM R : NUM")
)


def _tp_setting(text: str, target: Target) -> Setting:
    begin = target.spans[0][0]
    heads = list(_TP_HEAD.finditer(text[max(begin - BLOCK, 0) : begin]))
    if not heads:
        return Setting("", "")
    user, tool, configuration = heads[-1].groups(default="")
    fields = configuration.replace(",", " ").split()
    return Setting(_tp_name(text, "UTOOL", tool), _tp_name(text, "UFRAME", user), " ".join(fields))


def _tp_name(text: str, kind: str, number: str) -> str:
    """Return the name of a tool or user frame from its number in a TP program.

    For the number ``F`` (the active frame), it is the only frame that the program selects; empty if it selects none or
    several.

    Args:
        text: the program without comments.
        kind: beginning of the name, ``UTOOL`` or ``UFRAME``.
        number: number of the frame, or ``F``.
    """
    if not number.isdigit():
        selected = set(re.findall(rf"{kind}_NUM\s*=\s*(\d+)", text))
        if len(selected) != 1:
            return ""
        number = selected.pop()
    return f"{kind}[{int(number)}]"


def _tp_numbers(text: str, controller: Controller) -> tuple[Frames, Frames]:
    frames: dict[str, Frames] = {"UTOOL": {}, "UFRAME": {}}
    for match in _TP_LINE.finditer(text):
        frames[match[1]][f"{match[1]}[{match[2]}]"] = _posed(match, 3, controller)
    for section in _TP_SECTION.finditer(text):
        kind = "UTOOL" if section[1] == "MNUTOOL" else "UFRAME"
        for match in _TP_ENTRY.finditer(section[2]):
            frames[kind][f"{kind}[{match[1]}]"] = _posed(match, 2, controller)
    return frames["UTOOL"], frames["UFRAME"]


# --- KUKA KRL

_KRL_FRAME = _frame(r"\{ (?:FRAME : )?X NUM , Y NUM , Z NUM , A NUM , B NUM , C NUM \}")
_KRL_DECLARED = re.compile(rf"(?i)(?<![$\w])(\w+(?:\s*\[\s*\d+\s*\])?)\s*=\s*{_KRL_FRAME}")
_KRL_SELECTED = re.compile(r"(?i)\$(TOOL|BASE)\s*=\s*([^\n]*)|\bBAS\s*\(\s*#(TOOL|BASE)\s*,\s*(\d+)\s*\)")
_KRL_POINT = re.compile(r"(?i)(\w+)\s*=\s*\{\s*(?:E6POS\s*:|POS\s*:)?\s*X\s*$")
_KRL_DATA = r"(?i)\b{}\s*=\s*\{{[^}}]*?TOOL_NO\s+(\d+)\s*,\s*BASE_NO\s+(\d+)[^}}]*\}}"
_KRL_STATUS = re.compile(r"(?i)^\s*,\s*S\s+'?(B?[01]+|\d+)'?\s*,\s*T\s+'?(B?[01]+|\d+)'?")


def _krl_setting(text: str, target: Target) -> Setting:
    begin, end = target.spans[0][0], target.spans[-1][1]
    configuration = ""
    status = _KRL_STATUS.match(text[end : end + BEHIND])
    if status is not None:
        configuration = f"S {_binary(status[1])} T {_binary(status[2])}"
    point = _KRL_POINT.search(text[max(begin - BLOCK, 0) : begin])
    if point is None:
        return Setting(*_krl_active(text, begin), configuration)
    data = None
    if point[1][:1].upper() == "X":
        data = re.search(_KRL_DATA.format("F" + point[1][1:]), text)
    if data is not None:
        if re.search(r"(?i)IPO_FRAME\s+#TCP", data[0]):
            raise UsageError(
                f"line {target.line}: {point[1]} is relative to a tool fixed in the cell (IPO_FRAME #TCP), which is "
                "not supported: use a tool on the flange"
            )
        return Setting(_krl_name("TOOL", data[1]), _krl_name("BASE", data[2]), configuration)
    moves = re.finditer(rf"(?im)^\s*S?(?:PTP|LIN|CIRC)\b[^\n]*\b{re.escape(point[1])}\b", text)
    active = {_krl_active(text, move.start()) for move in moves}
    if not active:
        active = {_krl_active(text, len(text))}
    return Setting(*_either(active), configuration)


def _krl_active(text: str, position: int) -> tuple[str, str]:
    """Return the names of the tool and the base that are selected before a position in a KRL program's text."""
    active = {"TOOL": "", "BASE": ""}
    for match in _KRL_SELECTED.finditer(text, 0, position):
        if match[3]:
            kind = match[3].upper()
            active[kind] = _krl_name(kind, match[4])
            continue
        expression = re.sub(r"\s+", "", match[2])
        numbered = re.fullmatch(r"(?i)(TOOL|BASE)_DATA\[0*(\d+)\]", expression)
        kind = match[1].upper()
        if numbered:
            active[kind] = _krl_name(numbered[1].upper(), numbered[2])
        elif re.fullmatch(_KRL_FRAME, match[2].strip()):
            active[kind] = f"${kind} of line {text.count(chr(10), 0, match.start()) + 1}"
        else:
            active[kind] = expression.upper()
    return active["TOOL"], active["BASE"]


def _krl_name(kind: str, number: str) -> str:
    return f"{kind.upper()}_DATA[{int(number)}]"


def _binary(literal: str) -> int:
    """Return the integer written as a decimal (``2``) or as a binary literal (``B010``)."""
    if literal[:1].upper() == "B":
        return int(literal[1:], 2)
    return int(literal)


def _krl_numbers(text: str, controller: Controller) -> tuple[Frames, Frames]:
    frames: Frames = {}
    for match in _KRL_DECLARED.finditer(text):
        name = re.sub(r"\s+", "", match[1]).upper()
        frames[name] = _posed(match, 2, controller)
    selected: dict[str, Frames] = {"TOOL": {}, "BASE": {}}
    for match in _KRL_SELECTED.finditer(text):
        literal = re.fullmatch(_KRL_FRAME, (match[2] or "").strip())
        if literal:
            line = text.count("\n", 0, match.start()) + 1
            kind = match[1].upper()
            selected[kind][f"${kind} of line {line}"] = _posed(literal, 1, controller)
    return frames | selected["TOOL"], frames | selected["BASE"]


# --- ABB RAPID

_RAPID_TARGET = re.compile(r"(?i)\brobtarget\s+(\w+)\s*(?:\{[^}]*\}\s*)?:=\s*\[*\s*$")
_RAPID_POSE = _frame(r"\[ \[ NUM , NUM , NUM \] , \[ NUM , NUM , NUM , NUM \] \]")
_RAPID_TOOL = re.compile(rf"(?i)\btooldata\s+(\w+)\s*:=\s*\[\s*(TRUE|FALSE)\s*,\s*{_RAPID_POSE}")
_RAPID_WORK = re.compile(
    rf'(?i)\bwobjdata\s+(\w+)\s*:=\s*\[\s*(TRUE|FALSE)\s*,\s*(TRUE|FALSE)\s*,\s*"([^"]*)"\s*,\s*{_RAPID_POSE}\s*,\s*'
    rf"{_RAPID_POSE}"
)
_RAPID_CONFIGURATION = re.compile(r"\s*\]\s*,\s*\[\s*(-?\d+)\s*,\s*(-?\d+)\s*,\s*(-?\d+)\s*,\s*(-?\d+)\s*\]")
_RAPID_WOBJ = re.compile(r"(?i)\\WObj\s*:=\s*(\w+)")


def _rapid_setting(text: str, target: Target) -> Setting:
    begin, end = target.spans[0][0], target.spans[-1][1]
    configuration = ""
    configured = _RAPID_CONFIGURATION.match(text, end)
    if configured is not None:
        configuration = " ".join(configured.groups())
    declared = _RAPID_TARGET.search(text[max(begin - BLOCK, 0) : begin])
    if declared is None:
        statement = text[end : text.find(";", end)]
        return Setting(*_rapid_frames(statement), configuration)
    moves = re.finditer(rf"(?i)\bMove\w+\b([^;]*?\b{declared[1]}\b[^;]*);", text)
    frame_names = {_rapid_frames(move[1]) for move in moves}
    return Setting(*_either(frame_names), configuration)


def _rapid_frames(statement: str) -> tuple[str, str]:
    """Return the names of the tool and the work object that a RAPID move uses.

    Args:
        statement: arguments of the move; the last one is the tool.
    """
    work = _RAPID_WOBJ.search(statement)
    plain = re.sub(r"\\\w+(?:\s*:=\s*\w+)?", "", statement)
    tool = re.search(r",\s*([A-Za-z_]\w*)\s*$", plain)
    tool_name = "" if tool is None else tool[1].lower()
    work_name = "wobj0" if work is None else work[1].lower()
    return tool_name, work_name


def _rapid_numbers(text: str, controller: Controller) -> tuple[Frames, Frames]:
    tools: Frames = {}
    for match in _RAPID_TOOL.finditer(text):
        if match[2].upper() == "FALSE":
            raise UsageError(
                f"tooldata {match[1]}: a tool fixed in the cell (robhold FALSE) is not supported: use one on the flange"
            )
        tools[match[1].lower()] = _posed(match, 3, controller, 7)
    users: Frames = {}
    for match in _RAPID_WORK.finditer(text):
        if match[2].upper() == "TRUE":
            raise UsageError(
                f"wobjdata {match[1]}: a work object on the robot (robhold TRUE) is not supported: use one fixed in "
                "the cell"
            )
        if match[3].upper() == "FALSE" or match[4]:
            raise UsageError(
                f"wobjdata {match[1]}: a work object on a moving mechanical unit is not supported: use one fixed in "
                "the cell"
            )
        user_frame = _posed(match, 5, controller, 7)
        object_frame = _posed(match, 12, controller, 7)
        users[match[1].lower()] = user_frame @ object_frame
    return tools, users


# --- URScript

_UR_TCP = re.compile(r"\bset_tcp\s*\(\s*(.*)")
_UR_POSE = re.compile(_frame(r"p \[ NUM , NUM , NUM , NUM , NUM , NUM \]"))


def _ur_setting(text: str, target: Target) -> Setting:
    begin = target.spans[0][0]
    tool = ""
    for call in _UR_TCP.finditer(text):
        if call.start() < begin:
            tool = _ur_name(text, call)
    return Setting(tool, "Base")


def _ur_name(text: str, call: re.Match[str]) -> str:
    return f"set_tcp of line {text.count(chr(10), 0, call.start()) + 1}"


def _ur_numbers(text: str, controller: Controller) -> tuple[Frames, Frames]:
    tools: Frames = {}
    for call in _UR_TCP.finditer(text):
        pose = _UR_POSE.match(call[1])
        if pose:
            tools[_ur_name(text, call)] = _posed(pose, 1, controller)
    return tools, {}


TP = Language(
    comment="!",
    setting=_tp_setting,
    numbers=_tp_numbers,
    flange=("UTOOL[0]",),
    world=("UFRAME[0]",),
    files="SYSFRAME.VA of a backup, or lines as 'UTOOL[1]: X 0.0, Y 0.0, Z 0.0 mm, W 0.0, P 0.0, R 0.0 deg'",
)
KRL = Language(
    comment=";",
    setting=_krl_setting,
    numbers=_krl_numbers,
    flange=("TOOL_DATA[0]", "$NULLFRAME"),
    world=("BASE_DATA[0]", "$NULLFRAME", "$WORLD"),
    files="$config.dat, or lines as 'TOOL_DATA[1]={X 0.0,Y 0.0,Z 0.0,A 0.0,B 0.0,C 0.0}'",
)
RAPID = Language(
    comment="!",
    setting=_rapid_setting,
    numbers=_rapid_numbers,
    flange=("tool0",),
    world=("wobj0",),
    files="the module that declares tooldata and wobjdata",
)
URSCRIPT = Language(comment="#", setting=_ur_setting, numbers=_ur_numbers, flange=(), world=("Base",), files="")
LANGUAGES = {"tp": TP, "krl": KRL, "rapid": RAPID, "urscript": URSCRIPT}
