"""Train one policy that sees on several tasks, from pictures of which each has a look of its own.

    python experiments/train_seeing_policy.py --device cuda --out runs/seeing/policy.pt
    torchdlo evaluate runs/seeing/policy.pt --protocol varied --protocol paraphrased --protocol blanked

Scripted demonstrations are played and kept as scenes, and not played again; other processes draw them while the network
learns (`torchdlo.agents.policies.scene_training`). A run that was stopped or killed goes on with --resume.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from options import Parser, count

from torchdlo.agents.data.demonstration_scenes import BATCH, play_scenes, scene_file
from torchdlo.agents.distributed import make_executor
from torchdlo.agents.policies import language
from torchdlo.agents.policies.chunk_training import Training
from torchdlo.agents.policies.scene_training import FOLLOWED, SceneTraining, train_on_scenes
from torchdlo.errors import InputError

TASKS = ("coiling", "separation", "slingshot", "wiring_post", "coiling_left", "coiling_right")


def options(given: Sequence[str] | None = None) -> Any:
    """Read the options."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--tasks", default=",".join(TASKS), help="names, with commas")
    parser.add_argument("--shares", default="", help="how often each is drawn, with commas")
    parser.add_argument("--scenes", default="runs/seeing/scenes", help="folder of the demonstrations")
    parser.add_argument("--batches", type=count, default=7, help=f"of {BATCH} demonstrations of each task")
    parser.add_argument("--held-out", type=int, default=6, help="demonstrations of each task to judge by")
    parser.add_argument("--fidelity", default="coarse", help="of the demonstrations: published or coarse")
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 1) - 2), help="that play and draw")
    parser.add_argument("--threads", type=count, default=1, help="that learn on the processor")
    parser.add_argument("--pictures", type=count, default=150_000, help="in all; each has as many views as cameras")
    parser.add_argument("--size", type=count, default=96, help="of pictures [px]")
    parser.add_argument("--epochs", type=count, default=40, help="a checkpoint after each")
    parser.add_argument("--steps", type=count, default=100, help="of an epoch")
    parser.add_argument("--batch", type=count, default=768, help="pictures of a step")
    parser.add_argument("--rate", type=float, default=1e-3, help="largest learning rate")
    parser.add_argument("--word-rate", type=float, default=1.0, help="of what reads sentences, in times")
    parser.add_argument("--chunk", type=count, default=20, help="actions that the policy looks ahead")
    parser.add_argument("--width", type=count, default=192, help="numbers of a token")
    parser.add_argument("--seed", type=int, default=0, help="of everything")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="where to learn")
    parser.add_argument("--language", default=language.default_encoder(), help="minilm or hashed")
    parser.add_argument("--from", dest="start", default="", help="policy whose weights to begin with")
    parser.flag("resume", "go on from the checkpoint")
    parser.add_argument("--out", default="runs/seeing/policy.pt", help="file of the policy; empty: only play")
    return parser.parse_args(given)


def play(given: Any) -> None:
    """Play what was not played yet."""
    folder = Path(given.scenes)
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [(name, given.fidelity, k, folder) for k in range(given.batches) for name in given.tasks.split(",")]
    jobs = [job for job in jobs if not scene_file(folder, job[0], job[2]).exists()]
    with make_executor(given.workers) as executor:
        for k, good in executor.map(play_scenes, jobs):
            print(f"{jobs[k][0]}: {good} of {BATCH}", flush=True)


def told(stage: str, done: int, total: int, message: str) -> None:
    """Say now and then how it goes."""
    if done % 50 == 0 or done == total:
        print(stage, done, "of", total, message, flush=True)


def main(words: Sequence[str] | None = None) -> None:
    """Play, then learn."""
    given = options(words)
    torch.set_num_threads(given.threads)
    play(given)
    if not given.out:
        return
    scenes = SceneTraining(
        Path(given.scenes),
        tuple(given.tasks.split(",")),
        tuple(float(x) for x in given.shares.split(",") if x),
        given.fidelity,
        given.batches,
        given.held_out,
        given.pictures,
        given.size,
        given.steps * given.batch,
        max(1, given.workers),
    )
    training = Training(
        epochs=given.epochs,
        batch=given.batch,
        rate=given.rate,
        word_rate=given.word_rate,
        decay=0.02,
        average=0.999 if not given.start else 0.995,
        chunk=given.chunk,
        followed=FOLLOWED + 2,
        width=given.width,
        channels=(48, 96, 128),
        tokens=3,
        layers=3,
        recolor=0.15,
        seed=given.seed,
        device=given.device,
        language=given.language,
    )
    start = Path(given.start) if given.start else None
    try:
        found = train_on_scenes(
            scenes, Path(given.out), training, start=start, resume=given.resume, small=True, callback=told
        )
    except InputError as error:
        sys.exit(str(error))
    print(found["held_out"][-1] if "held_out" in found else "", f"policy: {given.out}", flush=True)


if __name__ == "__main__":
    main()
