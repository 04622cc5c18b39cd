"""Tasks: rows A v = b. Each kind is a class in a module of its own; none remembers anything of a control step."""

from qpavoid.control.tasks.base import Constant, RowTask
from qpavoid.control.tasks.build import build_tasks
from qpavoid.control.tasks.frame import FrameTask
from qpavoid.control.tasks.layout import in_order

__all__ = ["Constant", "FrameTask", "RowTask", "build_tasks", "in_order"]
