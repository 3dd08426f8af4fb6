"""Play and train whole tasks on a GPU: errors, agreement with the CPU, time, memory; tasks beside each other.

Each task is a process: actions of many scenes, the same for a few scenes on the CPU, then the gradient of a window.
"train" trains each algorithm for two short batches, and once more with a stop between. What is found is printed line by
line as it is found. With --profile a task is run once more alone, with a table of what takes the GPU's time.

examples:
  python experiments/bench_tasks_gpu.py --count 500 --log gpu_tasks.log --profile wiring_post
  python experiments/bench_tasks_gpu.py --smoke      # a few scenes on the CPU: does the script run?
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

from options import Parser

TASKS = "coiling,separation,unknotting,wiring_post,lifting,slingshot,wrapping,gathering,train"
FEW = 4
"""Scenes that are compared with the CPU."""


def options() -> Any:
    """Read the options."""
    parser = Parser(__file__, description=__doc__)
    parser.flag("smoke", "a few scenes of one task on the CPU, and training: does the script run?")
    parser.add_argument("--tasks", default=TASKS, help="names, with commas (%(default)s)")
    parser.add_argument("--count", type=int, default=500, help="scenes (%(default)s)")
    parser.add_argument("--actions", type=int, default=3, help="actions that are played (%(default)s)")
    parser.add_argument("--device", default="cuda", help="where (%(default)s)")
    parser.add_argument("--seconds", type=float, default=90.0, help="after which tasks are given up (%(default)s)")
    parser.add_argument("--log", metavar="FILE", default="", help="file that gets all lines; default: standard output")
    parser.add_argument("--profile", metavar="TASK", default="", help="task that is profiled at last")
    parser.add_argument("--only", default="", help="one task, in this process")
    return parser.parse_args()


class Report:
    """Lines of one task."""

    def __init__(self, name: str) -> None:
        """Begin."""
        self.name, self.began = name, time.perf_counter()

    def __call__(self, **found: Any) -> None:
        """Print what was found."""
        row = {"task": self.name, "at": round(time.perf_counter() - self.began, 1), **found}
        print(json.dumps(row, default=str), flush=True)

    def tried(self, what: str, run: Any) -> Any:
        """Return what `run` returns; print what it raises."""
        try:
            return run()
        except Exception as error:
            lines = traceback.format_exc().strip().splitlines()
            self(failed=what, error=f"{type(error).__name__}: {error}"[:1500], where=lines[-12:])
            return None


def synchronize(device: str) -> None:
    """Wait for the device."""
    import torch

    if device != "cpu":
        torch.cuda.synchronize()


def off(found: Any, expected: Any) -> float:
    """Return the greatest difference of tensors."""
    found, expected = (x.detach().double().cpu() for x in (found, expected))
    return float((found - expected).abs().max())


def play(task: Any, report: Report, chosen: Any) -> None:
    """Play actions on the device and a few scenes on the CPU."""
    import torch

    from torchdlo.agents.rl.episodes import TaskEpisodes

    actions = 0.5 * torch.rand(chosen.actions, chosen.count, task.width, generator=torch.Generator().manual_seed(0))
    actions = (2 * actions - 0.5) * torch.tensor(task.limit)
    on = actions.to(chosen.device)
    played = TaskEpisodes(task, chosen.count, device=chosen.device, seed=1)
    synchronize(chosen.device)
    report(done="built")
    played.reset()
    synchronize(chosen.device)
    report(done="reset")
    moved, rows, times = played.env.moved.cpu(), [], []
    for action in on:
        began = time.perf_counter()
        rows.append(played.step(action))
        synchronize(chosen.device)
        times.append(round(time.perf_counter() - began, 4))
    report(done="forward", seconds_of_actions=times)
    few = TaskEpisodes(task, min(FEW, chosen.count), execution="eager")
    few.begin(moved[:FEW])
    report(start_off=off(played.first[:FEW], few.first))
    for k, action in enumerate(actions):
        step = few.step(action[:FEW])
        report(
            action=k,
            observation_off=off(rows[k].observation[:FEW], step.observation),
            reward_off=off(rows[k].reward[:FEW], step.reward),
            failed=int(rows[k].failed.sum()),
            reward=float(step.reward[0]),
        )
    times = []
    for action in on:
        began = time.perf_counter()
        played.step(action)
        synchronize(chosen.device)
        times.append(round(time.perf_counter() - began, 4))
    began = time.perf_counter()
    played.reset()
    synchronize(chosen.device)
    found = {"seconds_per_action": min(times), "reset": round(time.perf_counter() - began, 3)}
    frames = task.fidelity.steps(task.frame_skip) * chosen.count / min(times)
    report(done="timed", frames_per_s=round(frames), **found, **memory(chosen.device))


def memory(device: str) -> dict[str, int]:
    """Return the most memory that was taken [MB]."""
    import torch

    return {} if device == "cpu" else {"peak_mb": round(torch.cuda.max_memory_allocated() / 2**20)}


def differentiate(task: Any, report: Report, chosen: Any) -> None:
    """Take the gradient of a window's rewards with respect to its actions, there and on the CPU."""
    import torch

    from torchdlo.agents.rl.episodes import TaskEpisodes

    count, window = chosen.count, min(2, chosen.actions)
    actions = 0.5 * torch.rand(window, count, task.width, generator=torch.Generator().manual_seed(0))
    actions = (2 * actions - 0.5) * torch.tensor(task.limit)

    def gradient(played: Any, given: Any) -> tuple[Any, float]:
        given = given.clone().requires_grad_()
        began = time.perf_counter()
        total = sum(played.step(action).reward.sum() for action in given)
        total.backward()
        synchronize(str(given.device.type))
        seconds = time.perf_counter() - began
        played.detach()
        return given.grad, round(seconds, 4)

    played = TaskEpisodes(task, count, device=chosen.device, seed=1, gradients=True)
    played.reset()
    moved = played.env.moved.cpu()
    found, first = gradient(played, actions.to(chosen.device))
    report(done="gradient", seconds=first, finite=float(torch.isfinite(found).all(-1).float().mean()))
    few = TaskEpisodes(task, min(FEW, chosen.count), execution="eager", gradients=True)
    few.begin(moved[:FEW])
    expected, _ = gradient(few, actions[:, :FEW])
    report(gradient_off=off(found[:, :FEW], expected), gradient_size=float(expected.abs().max()))
    _, later = gradient(played, actions.to(chosen.device))
    frames = window * task.fidelity.steps(task.frame_skip) * count / later
    seconds = {"seconds_per_action": round(later / window, 4)}
    report(done="gradient timed", frames_per_s=round(frames), **seconds, **memory(chosen.device))


def train(report: Report, chosen: Any) -> None:
    """Train all algorithms for two short batches of Coiling, straight and with a stop between."""
    import dataclasses

    import torch

    from torchdlo.agents.rl.episodes import TaskEpisodes
    from torchdlo.agents.rl.results import prepare_training
    from torchdlo.agents.rl.settings import training_preset
    from torchdlo.agents.rl.training import train as loop
    from torchdlo.envs import find

    task, count = dataclasses.replace(find("coiling"), horizon=4), min(64, chosen.count)
    for algos in (("ppo", "sac"), ("shac", "sapo")):
        shared = TaskEpisodes(task, count, device=chosen.device, gradients=algos[0] == "shac")
        for algo in algos:
            given = {"episodes": 2 * count, "count": count, "window": 2, "warm": 1, "device": chosen.device}

            def run(algo: str = algo, given: dict = given, shared: Any = shared) -> None:
                kept = []
                for stops in ((2,), (1, 2)):
                    with tempfile.TemporaryDirectory() as folder:
                        shared.generator.manual_seed(0)
                        for batches in stops:
                            settings = training_preset("coiling", algo, **given | {"episodes": batches * count})
                            trainer, _ = prepare_training(task, settings)
                            began, again = time.perf_counter(), batches > 1 and len(stops) > 1
                            done = loop(trainer, shared, settings, folder=Path(folder), resume=again)
                            seconds = round(time.perf_counter() - began, 2)
                        kept.append(torch.cat([p.detach().flatten().cpu() for p in trainer.policy.parameters()]))
                        row = {k: v for k, v in done.rows[-1].items() if isinstance(v, float)}
                        report(algo=algo, stops=stops, seconds=seconds, last=row)
                report(algo=algo, resumed_off=off(kept[1], kept[0]), size=float(kept[0].abs().max()))

            report.tried(algo, run)


def profile(name: str, report: Report, chosen: Any) -> None:
    """Print what takes the GPU's time in an action, and how often the CPU waits."""
    import torch
    from torch.profiler import ProfilerActivity

    from torchdlo.agents.rl.episodes import TaskEpisodes
    from torchdlo.envs import find

    task = find(name)
    played = TaskEpisodes(task, chosen.count, device=chosen.device, seed=1)
    played.reset()
    action, times = torch.zeros(chosen.count, task.width, device=chosen.device), []
    for _ in range(4):
        began = time.perf_counter()
        played.step(action)
        synchronize(chosen.device)
        times.append(round(time.perf_counter() - began, 4))
    report(alone=times, frames_per_s=round(task.fidelity.steps(task.frame_skip) * chosen.count / min(times)))
    kinds = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * (chosen.device != "cpu")
    with torch.profiler.profile(activities=kinds) as seen:
        played.step(action)
        synchronize(chosen.device)
    rows = seen.key_averages()
    sort = "self_cpu_time_total" if chosen.device == "cpu" else "self_device_time_total"
    print(rows.table(sort_by=sort, row_limit=25, max_name_column_width=60), flush=True)
    print(rows.table(sort_by="self_cpu_time_total", row_limit=25, max_name_column_width=60), flush=True)
    asked = ("cudaStreamSynchronize", "cudaLaunchKernel", "cuLaunchKernel", "cudaGraphLaunch", "cudaMemcpyAsync")
    report(calls={r.key: r.count for r in rows if r.key.startswith(asked)})


def one(name: str, chosen: Any) -> None:
    """Do one task in this process."""
    import torch

    from torchdlo.envs import find

    torch.set_num_threads(1)
    report = Report(name)
    report(torch=torch.__version__, gpu="" if chosen.device == "cpu" else torch.cuda.get_device_name())
    if name == "train":
        report.tried("train", lambda: train(report, chosen))
    elif chosen.profile:
        report.tried("profile", lambda: profile(name, report, chosen))
    else:
        task = find(name)
        report.tried("play", lambda: play(task, report, chosen))
        report.tried("differentiate", lambda: differentiate(task, report, chosen))


def main() -> None:
    """Run all tasks beside each other."""
    chosen = options()
    if chosen.smoke:
        chosen.device, chosen.count, chosen.actions = "cpu", FEW, 1
        chosen.tasks = "wiring_post,train" if chosen.tasks == TASKS else chosen.tasks
    if chosen.only or chosen.smoke:
        for name in [chosen.only] if chosen.only else chosen.tasks.split(","):
            one(name, chosen)
        return
    began = time.monotonic()
    with open(chosen.log, "a") if chosen.log else os.fdopen(os.dup(1), "a") as log:
        words = [sys.executable, "-u", __file__, "--count", str(chosen.count), "--actions", str(chosen.actions)]
        words += ["--device", chosen.device]

        def begin(name: str, *more: str) -> subprocess.Popen:
            return subprocess.Popen([*words, "--only", name, *more], stdout=log, stderr=log)

        running = [begin(name) for name in chosen.tasks.split(",") if name]
        while any(p.poll() is None for p in running) and time.monotonic() - began < chosen.seconds:
            time.sleep(0.5)
        for process in running:
            process.kill()
        if chosen.profile:
            last = begin(chosen.profile, "--profile", chosen.profile)
            try:
                last.wait(chosen.seconds)
            except subprocess.TimeoutExpired:
                last.kill()


if __name__ == "__main__":
    main()
