"""Objects of libraries written in C++ (Pinocchio, coal, MuJoCo), whose classes no type checker sees."""

from typing import Any, TypeAlias

NativeModel: TypeAlias = Any
"""A robot of Pinocchio or MuJoCo; of MuJoCo also what it is compiled from."""
NativeShape: TypeAlias = Any
"""A shape of coal, a collection of shapes, or a pose in Pinocchio's world."""
