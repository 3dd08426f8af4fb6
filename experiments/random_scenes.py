"""Run random scenes of ropes among bodies and look for what must not happen.

A kind of scene is a set of bodies; its scenes, which differ in everything else, run as one batch: a tangled rope of
random stiffness, friction and speed falls on a plane and on a free, a fixed and a moved body of random shapes, sizes,
densities and spins. Found at fault are scenes that are not finite, that missed a contact, whose edges are not as long
as they are meant to be, those in which things overlap by more than a share of the rope's radius once the rope is at
rest, and those whose energy rises while nothing moves the moved body: in the last quarter of the time and, with
--still, in all of it. A kind that is built and started again from the same seed, and a part of the run in the middle of
the pile that is repeated, have to end in the same bits.

examples:
  python experiments/random_scenes.py --scenes 1000 --json random_scenes.json
  python experiments/random_scenes.py --scenes 2000 --json random_scenes.json --resume
  python experiments/random_scenes.py --scenes 40 --batch 20 --seconds 0.5
  python experiments/random_scenes.py --integrator implicit --substeps 1 --deepest 0.05 --still
"""

from __future__ import annotations

import functools
import json
import math
import random
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from options import Parser, count, save

RADIUS, EDGE, VERTICES = 0.01, 0.02, 40
SIZES = {
    "sphere": (0.04,),
    "box": (0.05, 0.04, 0.03),
    "capsule": (0.02, 0.05),
    "cylinder": (0.03, 0.05),
    "cone": (0.05, 0.1),
    "torus": (0.06, 0.02),
    "ring": (0.06, 0.02, 4.0),
}
AT_REST = 0.05
"""Speed below which a rope counts as being at rest [m/s]."""
RISE = 1e-3
"""Rise of the energy above its least so far, over that at the start, above which a scene is at fault."""
LONGEST = 0.01
"""Strain of an edge above which a scene is at fault."""


def tangles(scenes: int, generator: Any) -> Any:
    """Return random smooth curves with even edges whose parts are two diameters apart, (scenes, VERTICES, 3)."""
    import torch

    found: list[Any] = []
    along = torch.linspace(0, 1, 1000, dtype=torch.float64)
    near = torch.ones(VERTICES, VERTICES).triu(4) > 0
    while len(found) < scenes:
        waves = torch.arange(1, 4, dtype=torch.float64)
        size = torch.randn(200, 3, 3, 1, generator=generator, dtype=torch.float64) / waves[:, None] * 0.12
        phase = 2 * math.pi * torch.rand(200, 3, 3, 1, generator=generator, dtype=torch.float64)
        curve = (size * torch.sin(math.pi * waves[:, None] * along + phase)).sum(2).mT
        length = torch.cat([torch.zeros(200, 1), (curve[:, 1:] - curve[:, :-1]).norm(dim=-1).cumsum(-1)], -1)
        for x, s in zip(curve, length, strict=True):
            if float(s[-1]) < (VERTICES - 1) * EDGE:
                continue
            at = torch.searchsorted(s, torch.arange(VERTICES) * EDGE).clamp(max=len(s) - 1)
            x = x[at]
            apart = torch.cdist(x, x)[near]
            turn = torch.nn.functional.cosine_similarity(x[2:] - x[1:-1], x[1:-1] - x[:-2], dim=-1)
            if float(apart.min()) > 4 * RADIUS and float(turn.min()) > 0.3:
                found.append(x - torch.stack([*x.mean(0)[:2], x[:, 2].min() - 0.25]))
    return torch.stack(found[:scenes])


def build(
    seed: int, scenes: int, step: tuple[float, int], integrator: str = "explicit"
) -> tuple[tuple[Any, Any, Any], list[str]]:
    """Return a kind of scene with its parameters and first state, and the shapes of its bodies."""
    import torch

    from torchdlo import scene
    from torchdlo.coupling import BodyContact, RodBody, RodContact
    from torchdlo.physics import tree
    from torchdlo.physics.effects.elastic import Bend
    from torchdlo.physics.effects.external import Damping, Gravity

    g = torch.Generator().manual_seed(seed)
    shapes = random.Random(seed).choices(sorted(SIZES), k=3)

    def uniform(low: float, high: float, *shape: int) -> Any:
        return low + (high - low) * torch.rand(scenes, *shape, generator=g, dtype=torch.float64)

    solids = [scene.RigidBody("plane", motion="fixed", mu_s=0.5, mu_k=0.4)]
    for k, (shape, motion) in enumerate(zip(shapes, ("free", "fixed", "kinematic"), strict=True)):
        angle = 2 * math.pi * k / 3
        at = torch.tensor([0.16 * math.cos(angle), 0.16 * math.sin(angle), 0.11], dtype=torch.float64)
        turn = torch.randn(scenes, 4, generator=g, dtype=torch.float64)
        size = torch.tensor(SIZES[shape], dtype=torch.float64) * uniform(0.6, 1.0, 1)
        if shape == "ring":
            size = torch.cat([size[:, :2], torch.full_like(size[:, :1], 4.0)], -1)
        free = motion == "free"
        moves = {"vel": uniform(-0.5, 0.5, 3), "omega": uniform(-5, 5, 3), "density": uniform(200, 2000)}
        rub = uniform(0, 0.8)
        solids.append(
            scene.RigidBody(
                shape, size, at + uniform(-0.02, 0.02, 3), turn / turn.norm(dim=-1, keepdim=True), motion=motion,
                mu_s=rub, mu_k=0.9 * rub, restitution=uniform(0, 0.6), name=f"{shape} {k}", **(moves if free else {}),
            )
        )  # fmt: skip
    rub = uniform(0, 0.6, 1, 1)
    values = {
        "damping": {"rate": 10 ** uniform(0, 1, 1, 1)},
        "rod_contact": {"mu_s": rub, "mu_k": 0.9 * rub, "restitution": uniform(0, 0.5, 1, 1)},
    }
    rope = scene.Rope(tangles(scenes, g), radius=RADIUS, density=1000.0, bend=1e-4)
    effects = [Gravity(), Bend(), Damping(), RodContact(burst=3.0, room=400), RodBody(), BodyContact()]
    made = scene.make([rope], effects, values, bodies=solids, dt=step[0], substeps=step[1], integrator=integrator)
    thrown = uniform(-1.0, 1.0, 1, 3) + uniform(-0.2, 0.2, VERTICES, 3)
    material = tree.replace(made[1].rods.material, bend=10 ** uniform(-6, -4, 1, 1))
    rods = tree.replace(made[1].rods, material=material)
    state = tree.replace(made[2], rods=tree.replace(made[2].rods, vel=tree.batch_innermost(thrown)))
    return (made[0], tree.replace(made[1], rods=rods), state), shapes


@functools.cache
def stepper(choice: Any) -> Any:
    """Return recorded steps of a scene."""
    from torchdlo import scene

    return scene.stepper(choice, execution="recorded")


def energy(made: tuple[Any, Any, Any], state: Any) -> Any:
    """Return the energy of the rope and of the free body [J], shape (scenes,)."""
    from torchdlo import measures
    from torchdlo.coupling.bodies.dynamics import conjugate
    from torchdlo.physics import tree
    from torchdlo.physics.linalg.rotation import rotate

    choice, params, _ = made
    # Velocities lie half a substep before positions.
    half = 0.5 * choice.dt / choice.substeps
    rods = tree.replace(state.rods, pos=state.rods.pos - half * state.rods.vel)
    of_rope = measures.kinetic_energy(choice, params, state) + measures.bending_energy(choice, params, state)
    of_rope = of_rope + measures.gravitational_energy(choice, params, tree.replace(state, rods=rods))
    # The first body is the plane, the second one is free.
    mass, inertia = params.bodies.mass[..., 1, 0], params.bodies.inertia[..., 1, :]
    bodies = tree.map(lambda x: x[..., 1, :], state.bodies)
    spin = rotate(conjugate(bodies.quat), bodies.omega)
    moving = 0.5 * mass * bodies.vel.square().sum(-1) + 0.5 * (inertia * spin.square()).sum(-1)
    return of_rope + moving + 9.81 * mass * (bodies.pos - half * bodies.vel)[..., 2]


@dataclass
class Watch:
    """Looks at the energy in frames from `first` on, unless that is None."""

    first: int | None
    least: Any = None
    rise: Any = 0.0
    """Most that it was above its least so far [J], shape (scenes,)."""

    def __call__(self, frame: int, made: tuple[Any, Any, Any], state: Any) -> None:
        if self.first is None or frame < self.first or frame % 5:
            return
        now = energy(made, state)
        self.least = now if self.least is None else self.least.minimum(now)
        self.rise = (now - self.least).clamp(min=self.rise)


def run(
    made: tuple[Any, Any, Any], state: Any, seconds: float, first: int, last: int, way: float = 0.06, watch: Any = None
) -> Any:
    """Return the state after frames `first` to `last` of a time; the moved body goes to and fro through the pile."""
    import torch

    from torchdlo import scene
    from torchdlo.physics import tree

    choice, params, placed = made
    control, step = scene.stationary_control(choice, placed), stepper(choice)
    with torch.no_grad():
        for k in range(first, last):
            # It comes to rest at three quarters of the time.
            share = min(1.0, (k + 1) * choice.dt / (0.75 * seconds))
            now = way * math.sin(math.pi * share) ** 2
            pos = control.bodies.pos + control.bodies.pos.new_tensor([now, now, 0.0])
            moved = tree.replace(control, bodies=tree.replace(control.bodies, pos=pos))
            state = step(params, state, moved)
            if watch is not None:
                watch(k, made, state)
    return state


def travel(
    made: tuple[Any, Any, Any], again: tuple[Any, Any, Any], seconds: float, still: bool
) -> tuple[Any, bool, Any]:
    """Return the last state, whether what is done twice ends in the same bits, and by how much the energy rose [J]."""
    import torch

    from torchdlo.physics import tree

    frames = round(seconds / made[0].dt)
    half, few = frames // 2, min(25, frames // 2)
    way = 0.0 if still else 0.06
    watch = Watch(1 if still else round(0.75 * frames) + 1)
    early = run(made, made[2], seconds, 0, few, way, watch)
    middle = run(made, early, seconds, few, half, way, watch)
    later = run(made, middle, seconds, half, half + few, way, watch)
    twice = run(again, again[2], seconds, 0, few, way), run(again, middle, seconds, half, half + few, way)
    pairs = zip(tree.leaves(twice), tree.leaves((early, later)), strict=True)
    end = run(made, later, seconds, half + few, frames, way, watch)
    return end, all(torch.equal(a, b) for a, b in pairs), watch.rise


def overlaps(made: tuple[Any, Any, Any], state: Any) -> tuple[Any, Any]:
    """Return how deep ropes are in bodies, and in themselves, over the radius, shape (scenes,) each."""
    import torch

    from torchdlo.coupling.bodies import shape_sdf as shapes
    from torchdlo.coupling.bodies.dynamics import conjugate
    from torchdlo.coupling.rod_contact import closest_points
    from torchdlo.physics.linalg.rotation import rotate

    choice, params, _ = made
    x = state.rods.pos
    ends = (x[:, :-1], x[:, 1:])
    share = torch.linspace(0, 1, 9, dtype=x.dtype)[:, None]
    points = torch.lerp(*(e.unsqueeze(2) for e in ends), share).flatten(1, 2)
    nearest = []
    for k, body in enumerate(choice.bodies):
        at, quat = state.bodies.pos[:, k : k + 1], state.bodies.quat[:, k : k + 1]
        size = params.bodies.size[..., k : k + 1, :]
        nearest.append(shapes.distance(body.shape, size, rotate(conjugate(quat), points - at)).amin((-1, -2)))
    first, second = torch.triu_indices(VERTICES - 1, VERTICES - 1, 3)
    one, two = (tuple(e[:, rows] for e in ends) for rows in (first, second))
    s, t = closest_points.closest_points(one, two)
    between = torch.lerp(*one, s) - torch.lerp(*two, t)
    inside = 1 - torch.stack(nearest).amin(0) / RADIUS
    return inside.clamp(min=0), (2 - between.norm(dim=-1).amin(-1) / RADIUS).clamp(min=0)


def examine(seed: int, scenes: int, options: Any) -> list[dict[str, Any]]:
    """Run a kind of scene and return a row for each of its scenes."""
    from torchdlo import scene

    way = (options.dt, options.substeps), options.integrator
    made, shapes = build(seed, scenes, *way)
    start = time.process_time()
    state, same, rise = travel(made, build(seed, scenes, *way)[0], options.seconds, options.still)
    rise = (rise / energy(made, made[2]).abs()).expand(scenes)
    used = time.process_time() - start
    x, v = state.rods.pos, state.rods.vel
    speed = v.norm(dim=-1).amax(-1)
    length = (x[:, 1:] - x[:, :-1]).norm(dim=-1)
    strain = (length / made[1].rods.rest.length[..., :-1, 0] - 1).abs().amax(-1)
    body, own = overlaps(made, state)
    finite, fine = scene.finite(state), scene.ok(state)
    rows = []
    for k in range(scenes):
        resting, deep = float(speed[k]) < AT_REST, max(float(body[k]), float(own[k]))
        faults = [
            name
            for name, wrong in (
                ("not finite", not bool(finite[k])),
                ("missed a contact", bool(finite[k]) and not bool(fine[k])),
                ("lengths", not float(strain[k]) <= LONGEST),
                ("overlaps at rest", resting and not deep <= options.deepest),
                ("gains energy", not float(rise[k]) <= RISE),
                ("other bits", not same),
            )
            if wrong
        ]
        numbers = {"speed": speed[k], "strain": strain[k], "in_bodies": body[k], "in_itself": own[k], "rise": rise[k]}
        row = {"kind": seed, "scene": k, "shapes": shapes, "at_rest": resting, "faults": faults}
        row |= {name: float(x) for name, x in numbers.items()} | {"missed": state.diagnostics[k, 0].tolist()}
        rows.append(row | {"cpu_s": used / scenes})
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how many scenes there were, and how many with each fault."""
    faults = sorted({f for r in rows for f in r["faults"]})
    resting = [r for r in rows if r["at_rest"]]
    deepest = max((max(r["in_bodies"], r["in_itself"]) for r in resting), default=None)
    return {
        "scenes": len(rows),
        "at_rest": len(resting),
        "deepest_at_rest": deepest,
        "faults": {f: sum(f in r["faults"] for r in rows) for f in faults},
    }


def earlier(parser: Parser, path: str, choices: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a file whose run is to go on; it must have been made with the same choices."""
    if not path or not Path(path).exists():
        there = f"there is no {path}" if path else "no --json is given"
        parser.error(f"--resume goes on with the file of --json, but {there}; leave out --resume")
    found = json.loads(Path(path).read_text())
    if found.get("choices") != choices:
        parser.error(f"{path} was made with {found.get('choices')}; --resume needs the same, not {choices}")
    return found["rows"]


def main() -> int:
    """Run kinds until there were enough scenes; what was found so far is in the file after each."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--json", metavar="FILE", default="", help="file that the results go to")
    parser.add_argument("--scenes", type=count, default=1000, help="scenes in all (%(default)s)")
    parser.add_argument("--batch", type=count, default=100, help="scenes of a kind, run together (%(default)s)")
    parser.add_argument("--seconds", type=float, default=2.0, help="simulated time (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the first kind (%(default)s)")
    parser.add_argument("--dt", type=float, default=2e-3, help="step [s] (%(default)s)")
    parser.add_argument("--substeps", type=count, default=4, help="substeps per step (%(default)s)")
    parser.add_argument("--integrator", choices=("explicit", "implicit"), default="explicit", help="(%(default)s)")
    parser.add_argument("--deepest", type=float, default=0.1, help="overlap at rest, over the radius (%(default)s)")
    parser.flag("still", "leave the moved body where it is, and watch the energy from the start")
    parser.flag("resume", "go on with the file of --json")
    options = parser.parse_args()
    names = ("batch", "seconds", "seed", "dt", "substeps", "integrator", "deepest", "still")
    choices = {name: getattr(options, name) for name in names}
    rows = earlier(parser, options.json, choices) if options.resume else []
    import torch

    torch.set_num_threads(1)
    seed = rows[-1]["kind"] + 1 if rows else options.seed
    while len(rows) < options.scenes:
        size = min(options.batch, options.scenes - len(rows))
        rows += examine(seed, size, options)
        seed += 1
        print(f"{len(rows):6} scenes: {summary(rows)}", flush=True)
        save(options.json, {"choices": choices, "summary": summary(rows), "rows": rows})
    return int(bool(summary(rows)["faults"]))


if __name__ == "__main__":
    sys.exit(main())
