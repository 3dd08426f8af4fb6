"""How long pictures take: two arms, a rope of 60 edges, a table and posts, per frame on one core.

Times are processor seconds, the least of several repeats; "loop" is with the arms' kinematics and a new look per frame.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from options import Parser, count, save


def least(work: Callable[[], object], repeats: int) -> float:
    """Return the least processor time of some repeats [ms]."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return 1e3 * min(times)


def scene():
    """Return a task's episode with two arms, posts, and one rope of 60 edges."""
    import torch

    from torchdlo.coupling.bodies.dynamics import RigidBody
    from torchdlo.envs.core import episode
    from torchdlo.envs.core.task import RADIUS, Arms, make, straight
    from torchdlo.envs.tasks.lifting import Lifting
    from torchdlo.scene import Rope

    class Posts(Lifting):
        """Posts and a straight rope."""

        arms = Arms(base=Lifting.arms.base, vertex=(8, 50))

        def build(self, moved):
            x = straight((0.3, 0.1, 0.012), 61, moved[:, 0])
            x = torch.cat([0.3 + 0.5 * (x[..., :1] - 0.3), x[..., 1:]], -1)
            posts = [RigidBody("cylinder", (0.02, 0.02), (0.4 + 0.1 * k, 0.2, 0.02), motion="fixed") for k in range(3)]
            return make(self, [Rope(x, RADIUS / 2, mass=0.01, youngs=1e4)], solids=posts)

    return episode.prepare(Posts(), 1, execution="eager")


def main() -> None:
    """Measure and print a table."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--repeats", type=count, default=20, help="repeats of each")
    parser.add_argument("--out", default="", help="JSON file for the numbers")
    parser.flag("smoke", "one repeat: does the script run?")
    options = parser.parse_args()
    if options.smoke:
        options.repeats = 1
    import torch

    from torchdlo.envs.observations.pixels import camera_rig, render_cameras
    from torchdlo.vision.look import Look, draw_look

    torch.set_num_threads(1)
    made = scene()
    world, generator, rows = made.start, torch.Generator().manual_seed(0), []
    for size in (96, 128, 256):
        rig = camera_rig(made, cameras=("front",), size=size)
        every = camera_rig(made, size=size)
        for samples in (1, 4):

            def one(rig=rig, samples=samples):
                return render_cameras(rig, world.state, world.joints, looks=(Look(),), samples=samples)

            def loop(every=every, samples=samples):
                looks = (draw_look(generator),)
                return render_cameras(
                    every, world.state, world.joints, looks=looks, samples=samples, depth=True, ids=True
                )

            front, frame = least(one, options.repeats), least(loop, options.repeats) / len(every.cameras)
            rows.append({"size": size, "samples": samples, "front_ms": round(front, 2), "loop_ms": round(frame, 2)})
            print(f"{size:4} px, {samples} samples: front {front:6.2f} ms, loop {frame:6.2f} ms a frame")
    save(options.out, {"cameras": len(every.cameras), "rows": rows})


if __name__ == "__main__":
    main()
