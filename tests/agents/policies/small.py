"""Tasks with short actions."""

from __future__ import annotations

import dataclasses

from torchdlo.envs import Task, find


def small(name: str, horizon: int) -> Task:
    task = find(name)
    settle, release = min(task.settle_steps, 1), min(task.release, 1)
    return dataclasses.replace(task, horizon=horizon, frame_skip=1, settle_steps=settle, release=release)
