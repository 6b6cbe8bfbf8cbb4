"""Ours and the baselines, behind one signature."""

from scopemap.benchmark.methods.method import Method, Task, Timing

__all__ = ["Method", "Task", "Timing"]
