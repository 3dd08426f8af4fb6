"""Three small problems that gradient descent solves through contact, and cannot solve without its gradient.

  push  a rope, held at both ends, pushes a ball to a goal
  hook  a rope that is led through a ring carries the ring to a goal
  pour  a plate tilts and pours sand on a target

Each is a scene file whose keys (where hands or the plate are at some times) are learned: torch.optim.Adam follows the
gradient of a smooth loss through all steps. Beside it runs the same optimiser with contact cut: the forces on what has
to be moved count as if they did not depend on anything. Nothing else connects the keys with the loss, so its gradient
is zero.

The exit code is 1 if a problem was not solved. The learned scenes are written as scene files, so that `torchdlo
simulate` and `torchdlo view` take them from there.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

from options import Parser, count, save

EXAMPLES = """examples:
  python experiments/learn_through_contact.py --problem push --pictures
  python experiments/learn_through_contact.py --iterations 5 --json learn.json
  torchdlo view runs/learn/push
"""
NAMES = ("push", "hook", "pour")


def one(name: str, args: Any, out: Path) -> dict[str, Any]:
    """Learn one problem with and without the gradient of contact, write its files, and return what was measured."""
    from learn_problems import PROBLEMS, described, learn, measured

    from torchdlo import scene_files
    from torchdlo.cli.progress import progress
    from torchdlo.files import write_atomically
    from torchdlo.scene_files.run import run, save_frames

    problem, begin = PROBLEMS[name], time.perf_counter()
    choices = {"iterations": args.iterations or problem.iterations, "seed": args.seed, "compiled": args.compiled}
    with progress() as callback:
        cut = learn(problem, cut=True, callback=lambda *said: callback(f"{name}, cut", *said), **choices)
        found = learn(problem, cut=False, callback=lambda *said: callback(name, *said), **choices)
        description = described(problem, found.keys)
        scene_files.save(description, out / "scene.json")
        frames = run(scene_files.read(out / "scene.json"), frame_stride=5)
    save_frames(frames, out / "frames.npz", description)
    (first, _), (value, solved) = measured(problem, run(problem.scene(), frame_stride=5)), measured(problem, frames)
    if args.pictures:
        from torchdlo.report.render.picture import stills_png

        write_atomically(out / f"{name}.png", stills_png(frames))
    if args.video:
        from torchdlo.report.render.video_writer import write_video

        write_video(frames, out / "motion.mp4", speed=0.2)
    row = {
        "problem": name,
        "loss at start": found.losses[0],
        "loss with the gradient of contact": min(found.losses),
        "loss with contact cut": min(cut.losses),
        "size of the first gradient": found.gradient,
        "size of the first gradient with contact cut": cut.gradient,
        "measure": problem.measure,
        "value at start": first,
        "value": value,
        "limit": problem.limit,
        "solved": solved and not frames.problem,
        "iterations": len(found.losses) - 1,
        "seconds": time.perf_counter() - begin,
        "losses": found.losses,
    }
    print(
        f"{name}: {problem.title}: loss {row['loss at start']:.3g} at the start, "
        f"{row['loss with the gradient of contact']:.3g} with the gradient of contact, "
        f"{row['loss with contact cut']:.3g} with contact cut "
        f"(first gradient {found.gradient:.3g} and {cut.gradient:.3g})\n"
        f"  {'solved' if row['solved'] else 'NOT SOLVED'}: {problem.measure} {first:.3g} at the start, {value:.3g} at "
        f"the end (limit {problem.limit:g}) "
        f"after {row['iterations']} iterations, {row['seconds']:.0f} s",
        flush=True,
    )
    if frames.problem:
        print(f"  {frames.problem}", file=sys.stderr)
    return row


def main() -> int:
    """Learn the problems."""
    parser = Parser("learn_through_contact.py", description=__doc__, epilog=EXAMPLES)
    parser.add_argument("--problem", default="", help=f"names, separated by commas: {', '.join(NAMES)}; all if empty")
    parser.add_argument(
        "--iterations", type=count, default=None, help="steps of Adam; those of the problem if not given"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the small random change of the first guess")
    parser.add_argument("--out", default="runs/learn", help="folder for scene files, frames and pictures")
    parser.add_argument("--json", default="", help="file for what was measured")
    parser.flag("compiled", "compile the steps first, which takes minutes and pays off for many iterations")
    parser.flag("pictures", "draw start, middle and end of what was learned; needs the extra view of the package")
    parser.flag("video", "and videos")
    parser.flag("smoke", "one step of the first problem: does the script run?")
    args = parser.parse_args()
    names = [n for n in args.problem.split(",") if n] or list(NAMES)
    if args.smoke:
        names, args.iterations = names[:1], 1
    wrong = [n for n in names if n not in NAMES]
    if wrong:
        parser.error(f"--problem {args.problem}: there is no {', '.join(wrong)}; known are {', '.join(NAMES)}")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    rows = [one(n, args, Path(args.out) / n) for n in names]
    save(args.json, {"rows": rows})
    return int(not all(row["solved"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
