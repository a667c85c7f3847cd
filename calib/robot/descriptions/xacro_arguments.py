"""Arguments of a robot description, which follow its file as on the command line of xacro."""

import re
import shlex

from calib.errors import refuse_robot

_ARGUMENTS = re.compile(r"(?:(?<=\.xacro)|(?<=\.conf))\s+(?=\w+:=)")


def split(path: str) -> tuple[str, dict[str, str]]:
    """Return the file and the xacro arguments in a text such as ``arm.urdf.xacro name:=value``.

    Args:
        path: the text; without arguments, the path alone.
    """
    file, *arguments_text = _ARGUMENTS.split(path, maxsplit=1)
    arguments: dict[str, str] = {}
    if arguments_text:
        for argument in shlex.split(arguments_text[0]):
            name, separator, value = argument.partition(":=")
            if not separator:
                refuse_robot(
                    file, f"'{argument}' is no xacro argument; write name:=value, values with blanks in quotes"
                )
            arguments[name] = value
    return file, arguments
