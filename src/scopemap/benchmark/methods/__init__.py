"""Ours and the baselines, behind one signature."""

from scopemap.benchmark.methods.method import Method, Task

__all__ = ["Method", "Task"]
