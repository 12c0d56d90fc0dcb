# mujoco is a compiled module without type information; without this every attribute is an error.
from typing import Any

def __getattr__(name: str) -> Any: ...
