"""Time torchdlo and its peers with contact: a rope slides off a smooth peg, of which the motion is known.

A rope of 60 vertices, 1 m long, radius 5 mm, 78.5 g, hangs over a fixed horizontal cylinder of radius 50 mm without
friction, one end 10 cm lower than the other. As long as it stays on the peg its displacement is x(t) = x0 cosh(t
sqrt(2 g / L)), whatever the radius of the peg: what one side gains in weight the other one loses. From x0 = 50 mm it
reaches 187 mm in 0.45 s. Reported for every time step: the mean and last error of the displacement (half the
difference in height of the ends), the largest strain of an edge, and simulated seconds per CPU second of all threads
with one scene and with many. Bending stiffness is 1e-5 N m^2 everywhere; peers without inextensible edges stretch with
a stiffness that is given in the row.

Each peer runs in an interpreter that has it, one thread (OMP_NUM_THREADS=1):
  python experiments/peers_contact.py --peer torchdlo --json contact.json
  peers/bin/python experiments/peers_contact.py --peer mujoco,pyelastica,dismech --json contact.json
  newton/bin/python experiments/peers_contact.py --peer newton --json contact.json
  python experiments/peers_contact.py --table contact.json

newton: pip install newton==1.8.0. dismech: pip install dismech-newton==0.1.0.post4, which brings newton 1.6.
"""

from __future__ import annotations

import itertools
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from options import Parser, count, save

LENGTH, RADIUS, DENSITY, BEND, VERTICES = 1.0, 0.005, 1000.0, 1e-5, 60
PEG, GRAVITY, START, DURATION, LOOKS = 0.05, 9.81, 0.05, 0.45, 9
EDGE = LENGTH / (VERTICES - 1)
AREA = math.pi * RADIUS**2
STIFFNESS = 1e6 * AREA
"""Axial stiffness [N] of peers whose edges stretch: 0.4 % under the greatest pull."""
TURNED = (math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0)
"""Quaternion (w, x, y, z) that lays a cylinder along y."""


@dataclass(frozen=True)
class Run:
    """What came of one run."""

    ends: np.ndarray
    """Heights of both ends at the times of `looks` [m], (LOOKS, 2)."""
    strain: float
    """Largest strain of an edge at these times."""
    cpu: float
    """CPU seconds of all threads, set-up not counted."""


@dataclass(frozen=True)
class Slide:
    """What came of one run with gradients."""

    gradient: float
    """Derivative of the last displacement with respect to a first speed along the rope [s]."""
    cpu: float
    """CPU seconds of all threads, forward and backward, set-up not counted."""


def polygon() -> np.ndarray:
    """Vertices at the start, (V, 3) [m]: edges of the same length whose middles touch the peg."""
    around = math.hypot(PEG + RADIUS, EDGE / 2)
    turn = 2 * math.asin(EDGE / 2 / around)

    def march(left: float) -> np.ndarray:
        points = [np.array([-around, -left])]
        for _ in range(VERTICES - 1):
            x, z = points[-1]
            if x < 0 and z + EDGE <= 0:
                points.append(np.array([x, z + EDGE]))
            elif x < 0 and z < 0:  # from the straight part to the arc: bisection over the angle
                low, high = 0.0, math.pi / 2
                for _ in range(60):
                    middle = (low + high) / 2
                    far = math.hypot(around - around * math.cos(middle), around * math.sin(middle) - z) >= EDGE
                    low, high = (low, middle) if far else (middle, high)
                points.append(around * np.array([-math.cos(low), math.sin(low)]))
            elif z > 0 and math.atan2(z, x) >= turn:
                angle = math.atan2(z, x) - turn
                points.append(around * np.array([math.cos(angle), math.sin(angle)]))
            elif x < around:
                points.append(np.array([around, z - math.sqrt(max(EDGE**2 - (around - x) ** 2, 0.0))]))
            else:
                points.append(np.array([x, z - EDGE]))
        return np.array(points)

    low, high = 0.0, LENGTH
    for _ in range(60):
        middle = (low + high) / 2
        found = march(middle)
        low, high = (low, middle) if found[0, 1] - found[-1, 1] < 2 * START else (middle, high)
    flat = march(low)
    return np.stack([flat[:, 0], np.zeros(VERTICES), flat[:, 1]], -1)


def displacement(t: np.ndarray) -> np.ndarray:
    """How far the rope has slid by t [s], closed form [m]."""
    return START * np.cosh(t * math.sqrt(2 * GRAVITY / LENGTH))


def sensitivity() -> float:
    """Derivative of the displacement at the end with respect to a first speed along the rope, closed form [s]."""
    rate = math.sqrt(2 * GRAVITY / LENGTH)
    return math.sinh(rate * DURATION) / rate


def _along(gradient: np.ndarray) -> float:
    """Sum of a gradient with respect to velocities (V, 3) over a slide along the rope, left end up."""
    tangent = np.gradient(polygon(), axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return float((gradient * tangent).sum())


def step_count(dt: float) -> int:
    """Number of steps of about dt [s], a multiple of LOOKS."""
    return LOOKS * max(1, round(DURATION / LOOKS / dt))


def play(steps: int, advance: Callable[[int], None], look: Callable[[], np.ndarray]) -> Run:
    """Run, and look at the vertices (V, 3) of the first scene LOOKS times; looking is not timed."""
    rest = np.linalg.norm(np.diff(polygon(), axis=0), axis=1)
    ends, strain, cpu = [], 0.0, 0.0
    for _ in range(LOOKS):
        began = time.process_time()
        advance(steps // LOOKS)
        cpu += time.process_time() - began
        x = look()
        ends.append((x[0, 2], x[-1, 2]))
        strain = max(strain, float(np.abs(np.linalg.norm(np.diff(x, axis=0), axis=1) / rest - 1).max()))
    return Run(np.array(ends), strain, cpu)


def _torchdlo_scene(dt: float, scenes: int, integrator: str, substeps: int) -> tuple[Any, Any, Any, int]:
    """Scene, parameters, state and number of steps; double precision for one scene, single for many."""
    import torch

    from torchdlo import scene
    from torchdlo.coupling import RodBody
    from torchdlo.physics.effects.elastic import Bend
    from torchdlo.physics.effects.external import Gravity

    torch.set_num_threads(1)
    x = torch.as_tensor(polygon(), dtype=torch.float64 if scenes == 1 else torch.float32)
    rope = scene.Rope(x if scenes == 1 else x.repeat(scenes, 1, 1), radius=RADIUS, density=DENSITY, bend=BEND)
    peg = scene.RigidBody("cylinder", (PEG, 0.1), quat=TURNED, motion="fixed", mu_s=0.0, mu_k=0.0)
    steps = step_count(dt)
    effects = [Gravity(), Bend(), RodBody()]
    choices: dict[str, Any] = {"dt": DURATION / steps, "substeps": substeps, "integrator": integrator}
    cable, params, state = scene.make([rope], effects, bodies=[peg], **choices)
    return cable, params, state, steps


def run_torchdlo(
    dt: float, scenes: int = 1, *, integrator: str = "implicit", substeps: int = 1, execution: str = "recorded"
) -> Run:
    """Steps of torchdlo without gradients."""
    from torchdlo import scene

    cable, params, state, steps = _torchdlo_scene(dt, scenes, integrator, substeps)
    control = scene.stationary_control(cable, state)
    step = scene.stepper(cable, execution=execution)
    step(params, state, control)  # loads kernels
    now = [state]

    def advance(n: int) -> None:
        for _ in range(n):
            now[0] = step(params, now[0], control)

    return play(steps, advance, lambda: now[0].rods.pos.reshape(-1, VERTICES, 3)[0].double().numpy())


def gradient_torchdlo(dt: float, scenes: int = 1, *, integrator: str = "implicit", substeps: int = 1) -> Slide:
    """Forward and backward through all steps, ten at a time."""
    import torch

    from torchdlo import scene
    from torchdlo.physics import tree

    cable, params, state, steps = _torchdlo_scene(dt, scenes, integrator, substeps)
    control = scene.stationary_control(cable, state)
    controls = tree.map(lambda c: c.expand(steps, *c.shape), control)
    step = scene.stepper(cable, execution="eager")

    def once(controls: Any) -> tuple[Any, Any]:
        vel = torch.zeros_like(state.rods.pos, requires_grad=True)
        moving = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
        last, _ = scene.rollout(step, params, moving, controls, segment=10)
        ends = last.rods.pos[..., [0, -1], 2]
        ((ends[..., 0] - ends[..., 1]) / 2).sum().backward()
        return last, vel

    once(tree.map(lambda c: c[:2], controls))  # loads kernels
    began = time.process_time()
    _, vel = once(controls)
    cpu = time.process_time() - began
    return Slide(_along(vel.grad.reshape(-1, VERTICES, 3)[0].double().numpy()), cpu)


def run_mujoco(dt: float, scenes: int = 1, *, solref: float = 0.002) -> Run:
    """MuJoCo: a flex of inextensible edges (equality constraints) in soft contact, integrator `discrete`."""
    import mujoco
    from mujoco import batch

    steps = step_count(dt)
    points = " ".join(f"{v:.17g}" for v in polygon().ravel())
    elements = " ".join(f"{i} {i + 1}" for i in range(VERTICES - 1))
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <option timestep="{DURATION / steps!r}" integrator="discrete" solver="Newton" gravity="0 0 -{GRAVITY}"/>
  <worldbody>
    <geom type="cylinder" size="{PEG} 0.1" quat="{" ".join(map(str, TURNED))}" condim="1"
          solref="{solref} 1" solimp="0.99 0.999 0.0001"/>
    <flexcomp name="rope" type="direct" dim="1" point="{points}" element="{elements}" mass="1" radius="{RADIUS}">
      <edge equality="true" solref="0.0005 1" solimp="0.99 0.999 0.0001"/>
      <contact selfcollide="none" condim="1" solref="{solref} 1" solimp="0.99 0.999 0.0001"/>
      <elasticity young="{4 * BEND / (math.pi * RADIUS**4)}" poisson="0.4999" damping="0"/>
    </flexcomp>
  </worldbody>
</mujoco>""")
    for i in range(VERTICES):
        share = 0.5 if i in (0, VERTICES - 1) else 1.0
        model.body(f"rope_{i}").mass = DENSITY * AREA * EDGE * share
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data = mujoco.MjData(model)

    if scenes > 1:
        many = batch.Batch(model, nsim=scenes, nthread=1)

        def look_many() -> np.ndarray:
            first = many.get_data(0)
            mujoco.mj_kinematics(model, first)
            mujoco.mj_flex(model, first)
            return first.flexvert_xpos.copy()

        return play(steps, lambda n: many.step(nstep=n), look_many)

    def look() -> np.ndarray:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_flex(model, data)
        return data.flexvert_xpos.copy()

    found = play(steps, lambda n: mujoco.mj_step(model, data, n), look)
    bad = (mujoco.mjtWarning.mjWARN_BADQACC, mujoco.mjtWarning.mjWARN_BADQVEL)
    if any(data.warning[w].number for w in bad):  # it resets itself
        return Run(np.full((LOOKS, 2), np.nan), math.nan, found.cpu)
    return found


def run_pyelastica(dt: float, scenes: int = 1, *, k: float = 1e3, nu: float = 0.0) -> Run:
    """PyElastica: Cosserat rods with penalty contact; explicit, so steps are bounded by their axial stiffness."""
    import elastica as ea

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Contact):
        pass

    simulator, rods, start = Simulator(), [], polygon()
    for _ in range(scenes):
        rod = ea.CosseratRod.straight_rod(
            VERTICES - 1, np.zeros(3), np.array([0.0, 0, 1]), np.array([0.0, 1, 0]), LENGTH, RADIUS, DENSITY,
            youngs_modulus=STIFFNESS / AREA,
        )  # fmt: skip
        rod.bend_matrix[:2, :2] *= BEND / (STIFFNESS / AREA * math.pi * RADIUS**4 / 4)
        rod.position_collection[:] = start.T
        tangents = np.diff(start, axis=0) / EDGE
        normal = np.broadcast_to([0.0, 1.0, 0.0], tangents.shape)
        rod.director_collection[0], rod.director_collection[2] = normal.T, tangents.T
        rod.director_collection[1] = np.cross(tangents, normal).T
        peg = ea.Cylinder(np.array([0.0, -0.1, 0]), np.array([0.0, 1, 0]), np.array([1.0, 0, 0]), 0.2, PEG, 1e3)
        simulator.append(rod)
        simulator.append(peg)
        simulator.constrain(peg).using(ea.FixedConstraint, constrained_position_idx=(0,), constrained_director_idx=(0,))
        simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=np.array([0.0, 0.0, -GRAVITY]))
        simulator.detect_contact_between(rod, peg).using(ea.RodCylinderContact, k=k, nu=nu)
        rods.append(rod)
    simulator.finalize()
    stepper, steps, now = ea.PositionVerlet(), step_count(dt), [0.0]

    def advance(n: int) -> None:
        with np.errstate(all="ignore"):
            for _ in range(n):
                now[0] = stepper.step(simulator, now[0], DURATION / steps)

    return play(steps, advance, lambda: rods[0].position_collection.T.copy())


def _newton_model(add: Callable[[Any, Any, Any], Any], scenes: int, density: float, **rest: bool) -> Any:
    """A model of Newton with so many worlds: peg and rope, which `add(builder, rod, cfg)` adds."""
    import newton
    import warp as wp

    wp.config.quiet = True
    wp.set_device("cpu")
    one = newton.ModelBuilder()  # falls along -z at 9.81 m/s^2
    one.rigid_gap = 0.0
    cfg = newton.ModelBuilder.ShapeConfig(density=density, mu=0.0, ke=1e5, kd=0.0)
    one.default_shape_cfg.mu = 0.0
    w, x, y, z = TURNED
    one.add_shape_cylinder(
        -1, xform=wp.transform(wp.vec3(0.0, 0.0, 0.0), wp.quat(x, y, z, w)), radius=PEG, half_height=0.1, cfg=cfg
    )
    add(one, newton.Rod([wp.vec3(*map(float, p)) for p in polygon()], radius=RADIUS, **rest), cfg)
    builder = one
    if scenes > 1:
        builder = newton.ModelBuilder()  # falls along -z at 9.81 m/s^2
        builder.rigid_gap = 0.0
        builder.replicate(one, scenes)
    return builder


def run_newton(dt: float, scenes: int = 1, *, iterations: int = 10) -> Run:
    """Newton: capsules with rod joints by vertex block descent (SolverVBD), on the CPU."""
    import newton
    import warp as wp

    def add(builder: Any, rod: Any, cfg: Any) -> Any:
        stretch, bend = STIFFNESS / EDGE, BEND / EDGE
        return builder.add_rod(rod=rod, cfg=cfg, stretch_stiffness=stretch, bend_stiffness=bend)

    # Its segments are capsules, whose round ends overlap: their mass is to be that of the rope.
    builder = _newton_model(add, scenes, DENSITY / (1 + 4 / 3 * RADIUS / EDGE), rest_straight=True)
    builder.color()
    model = builder.finalize(device="cpu")
    pipeline = newton.CollisionPipeline(model, contact_matching="sticky")
    contacts = pipeline.contacts()
    solver = newton.solvers.SolverVBD(
        model, iterations=iterations, rigid_contact_history=True, rigid_body_contact_buffer_size=64
    )
    states, control, steps = [model.state(), model.state()], model.control(), step_count(dt)

    def advance(n: int) -> None:
        for _ in range(n):
            states[0].clear_forces()
            pipeline.collide(states[0], contacts)
            solver.step(states[0], states[1], control, contacts, DURATION / steps)
            states.reverse()

    def look() -> np.ndarray:
        pose = states[0].body_q.numpy()[: VERTICES - 1]
        half = [np.array(wp.quat_rotate(wp.quat(*map(float, p[3:])), wp.vec3(0.0, 0.0, EDGE / 2))) for p in pose]
        first = pose[:, :3] - half
        return np.concatenate([first, pose[-1:, :3] + half[-1]])

    return play(steps, advance, look)


def _dismech_solver(scenes: int, iterations: int, gradient: bool = False) -> tuple[Any, Any]:
    """Model and solver."""
    import warp

    if sys.version_info < (3, 14):  # annotations `Slots | None` of instances are only deferred from 3.14 on
        type(warp.struct(type("Kind", (), {}))).__or__ = lambda kind, other: Any
    from dismech_newton import DiSMechSolver

    def add(builder: Any, rod: Any, cfg: Any) -> Any:
        stretch, bend = STIFFNESS / EDGE, BEND / EDGE
        return DiSMechSolver.add_rod(builder, rod, cfg=cfg, stretch_stiffness=stretch, bend_stiffness=bend)

    model = _newton_model(add, scenes, DENSITY).finalize(device="cpu", requires_grad=gradient)
    solver = DiSMechSolver(model, iterations=iterations, self_contact=False, friction=0.0)
    for part in solver.elements:
        part.rest.zero_()  # straight at rest; it takes the start for the rest shape
    return model, solver


def run_dismech(dt: float, scenes: int = 1, *, iterations: int = 10) -> Run:
    """dismech-newton: implicit discrete elastic rods by ADMM with contact, on the CPU."""
    model, solver = _dismech_solver(scenes, iterations)
    states, control, steps = [model.state(), model.state()], model.control(), step_count(dt)

    def advance(n: int) -> None:
        for _ in range(n):
            solver.step(states[0], states[1], control, None, DURATION / steps)
            states.reverse()

    return play(steps, advance, lambda: states[0].particle_q.numpy()[:VERTICES].astype(float))


def gradient_dismech(dt: float, scenes: int = 1, *, iterations: int = 10) -> Slide:
    """The same with its adjoint, states of all steps kept."""
    import warp

    model, solver = _dismech_solver(scenes, iterations, gradient=True)
    control = model.control()

    def once(steps: int) -> np.ndarray:
        states = [model.state(requires_grad=True) for _ in range(steps + 1)]
        tape = warp.Tape()
        with tape:
            for before, after in itertools.pairwise(states):
                solver.step(before, after, control, None, dt)
        seed = np.zeros((model.particle_count, 3), np.float32)
        seed[::VERTICES, 2], seed[VERTICES - 1 :: VERTICES, 2] = 0.5, -0.5
        tape.backward(grads={states[-1].particle_q: warp.array(seed, dtype=warp.vec3, device="cpu")})
        return states[0].particle_qd.grad.numpy()

    once(2)  # compiles
    steps = step_count(dt)
    dt = DURATION / steps
    began = time.process_time()
    found = once(steps)
    return Slide(_along(found[:VERTICES].astype(float)), time.process_time() - began)


PEERS: dict[str, tuple[str, Callable[..., Run], Callable[..., Slide] | None, list[dict[str, Any]], list[float]]] = {
    "torchdlo implicit": ("torchdlo", run_torchdlo, gradient_torchdlo, [{}], [1e-3, 2e-3, 5e-3]),
    "torchdlo explicit": (
        "torchdlo", run_torchdlo, None, [{"integrator": "explicit", "substeps": 5}], [1e-3],
    ),
    "MuJoCo": ("mujoco", run_mujoco, None, [{"solref": s} for s in (0.002, 0.02, 0.05)], [1e-3, 2e-3, 5e-3]),
    "PyElastica": (
        "pyelastica", run_pyelastica, None, [{"k": k, "nu": nu} for k in (1e3, 1e4) for nu in (0.0, 0.1)], [5e-5, 1e-4],
    ),
    "Newton VBD": ("newton", run_newton, None, [{"iterations": n} for n in (10, 40)], [1e-3, 2e-3, 5e-3]),
    "dismech-newton": (
        "dismech-newton", run_dismech, gradient_dismech, [{"iterations": n} for n in (10, 40)], [1e-3, 2e-3, 5e-3],
    ),
}  # fmt: skip
"""What is run: name of the package, forward, with gradients, settings, steps [s]."""


def _errors(run: Run) -> dict[str, float]:
    """Errors of the displacement [m]: mean over the times, and at the end."""
    times = DURATION * np.arange(1, LOOKS + 1) / LOOKS
    off = (run.ends[:, 0] - run.ends[:, 1]) / 2 - displacement(times)
    return {"mean_error_m": float(np.abs(off).mean()), "last_error_m": float(off[-1])}


def measure(name: str, scenes: int, repeats: int, gradients: bool, smoke: bool = False) -> list[dict[str, Any]]:
    """Rows of one peer: each setting and step, in one scene and in `scenes`; the fastest repeat counts."""
    package, run, derive, settings, steps = PEERS[name]
    settings, steps = (settings[:1], steps[-1:]) if smoke else (settings, steps)
    rows: list[dict[str, Any]] = []
    run(DURATION / LOOKS, **settings[0])  # compiles
    for setting in settings:
        for dt in steps:
            one = [run(dt, **setting) for _ in range(repeats)]
            row: dict[str, Any] = {
                "peer": name,
                "version": version(package),
                "dt": DURATION / step_count(dt),
                **setting,
            }
            row |= _errors(one[0]) | {"strain": one[0].strain, "one_per_cpu_s": DURATION / min(r.cpu for r in one)}
            if scenes > 1:
                many = [run(dt, scenes, **setting) for _ in range(repeats)]
                row |= {"scenes": scenes} | {f"many_{k}": v for k, v in _errors(many[0]).items()}
                row["many_per_cpu_s"] = scenes * DURATION / min(r.cpu for r in many)
            if gradients and derive is not None:
                slides = [derive(dt, **setting) for _ in range(repeats)]
                row["gradient_error"] = slides[0].gradient / sensitivity() - 1
                row["gradient_one_per_cpu_s"] = DURATION / min(s.cpu for s in slides)
                if scenes > 1:
                    cpu = min(derive(dt, scenes, **setting).cpu for _ in range(repeats))
                    row["gradient_many_per_cpu_s"] = scenes * DURATION / cpu
            rows.append(row)
            print(
                "  ",
                ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()),
                flush=True,
            )
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a table of Markdown."""
    head = ["", "step", "mean error", "last error", "strain", "one scene", "mean error", "many"]
    head += ["with gradient, one", "many", "off"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]

    def speed(row: dict[str, Any], key: str) -> str:
        if key not in row:
            return ""
        return f"{row[key]:.2g}" + (f" ({row['scenes']})" if "many" in key else "")

    for row in rows:
        setting = "".join(f", {k} {row[k]}" for k in ("solref", "iterations", "k", "nu") if k in row)
        cells = [f"{row['peer']} {row['version']}{setting}", f"{1e3 * row['dt']:.3g} ms"]
        cells += [f"{1e3 * row[k]:.2g} mm" for k in ("mean_error_m", "last_error_m")]
        cells.append(f"{row['strain']:.1%}")
        cells.append(speed(row, "one_per_cpu_s"))
        cells.append(f"{1e3 * row['many_mean_error_m']:.2g} mm" if "many_mean_error_m" in row else "")
        cells += [speed(row, f"{k}_per_cpu_s") for k in ("many", "gradient_one", "gradient_many")]
        cells.append(f"{row['gradient_error']:+.1%}" if "gradient_error" in row else "")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure and save, or print the table."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--peer", default="torchdlo", help=f"beginnings of names, with commas: {', '.join(PEERS)}")
    parser.add_argument("--scenes", type=count, default=100, help="scenes of the run with many")
    parser.add_argument("--repeats", type=count, default=2, help="timings of each; the fastest counts")
    parser.flag("smoke", "one scene, one setting, the longest step: does the script run?")
    parser.flag("gradients", "forward and backward as well, where a peer has it")
    parser.add_argument(
        "--json", default="", metavar="FILE", help="file that rows are added to, one peer's in place of its old ones"
    )
    parser.add_argument("--table", default="", metavar="FILE", help="print the table of such a file, and end")
    chosen = parser.parse_args()
    if chosen.table:
        sys.stdout.write(table(json.loads(Path(chosen.table).read_text())["rows"]))
        return
    wanted = chosen.peer.lower().split(",")
    for name in PEERS:
        if not any(name.lower().startswith(w) for w in wanted):
            continue
        print(name, flush=True)
        rows = measure(
            name, *((1, 1, False, True) if chosen.smoke else (chosen.scenes, chosen.repeats, chosen.gradients))
        )
        old = json.loads(Path(chosen.json).read_text())["rows"] if chosen.json and Path(chosen.json).exists() else []
        save(chosen.json, {"rows": [r for r in old if r["peer"] != name] + rows})


if __name__ == "__main__":
    main()
