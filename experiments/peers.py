"""Time the peers on the falling rope: PyElastica (Cosserat rods) and MuJoCo (rods of flexes).

Rope of 60 vertices, 1 m long, radius 5 mm, 1000 kg/m^3, E = 1e6 Pa, clamped horizontally at the
origin (vertices 0 and 1) and released for 1 s without damping. Reported per peer and time step:
the tip's error after 1 s against the converged run in tests/reference/swing.npz, and simulated
seconds per CPU second with one scene and with many. Run it with an interpreter that has the
extra `peers` (pyelastica, mujoco); it imports nothing of torchdlo. Set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from options import Parser, count, save

LENGTH, RADIUS, DENSITY, YOUNGS, DURATION, EDGES = 1.0, 0.005, 1000.0, 1e6, 1.0, 59
AREA = math.pi * RADIUS**2
GRAVITY = np.array([0.0, 0.0, -9.81])
FRAMES = 20
"""Times at which the tip is compared, evenly spaced up to DURATION."""
DISCRETE = '<edge equality="true" solref="0.0005 1" solimp="0.99 0.999 0.0001"/>'


@dataclass(frozen=True)
class Config:
    """What is timed and how often."""

    peer: str = "all"
    """pyelastica, mujoco or all."""
    scenes: int = 100
    """Number of scenes in the run with many."""
    workers: int = 2
    """Processes (PyElastica) and threads (MuJoCo) of the run with many."""
    repeats: int = 3
    """Timings per time step; the fastest counts."""
    reference: str = str(Path(__file__).resolve().parents[1] / "tests" / "reference" / "swing.npz")
    """File with the converged runs."""
    json: str = ""
    """File the results go to."""
    smoke: bool = False
    """Few steps and scenes, to see that the script runs."""


@dataclass(frozen=True)
class Clamp:
    """Where the held edge lies."""

    exact: bool = False
    """Whether the rod is extended so that the held edge has its middle at the origin."""

    def edge(self, n: int) -> float:
        """Length of an edge [m]."""
        return LENGTH / (n - 0.5) if self.exact else LENGTH / n

    def start(self, n: int) -> float:
        """Coordinate of vertex 0 along x [m]."""
        return -self.edge(n) / 2 if self.exact else 0.0


@dataclass(frozen=True)
class Timed:
    """Outcome of one run over DURATION."""

    tips: np.ndarray
    """Tip of the first scene over time [m], (FRAMES, 3), or at the end only, (1, 3)."""
    cpu: float
    """CPU seconds of all threads, set-up not counted [s]."""
    wall: float
    """Elapsed time of the same [s]."""
    strain: float = 0.0
    """Largest strain of an edge that should not stretch, at the times of `tips`."""


def step_count(dt: float) -> int:
    """Number of steps of at most dt [s], a multiple of FRAMES."""
    return FRAMES * math.ceil(DURATION / FRAMES / dt - 1e-9)


def clocked(work: Callable[[], None]) -> tuple[float, float]:
    """CPU seconds of this process, all threads, and elapsed seconds of a call."""
    cpu, wall = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - cpu, time.perf_counter() - wall


def run_elastica(dt: float, scenes: int = 1, clamp: Clamp | None = None) -> Timed:
    """PyElastica: all scenes in one simulator, which packs their rods into one block."""
    import elastica as ea

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing):
        pass

    clamp = clamp or Clamp()
    simulator, rods = Simulator(), []
    for _ in range(scenes):
        rod = ea.CosseratRod.straight_rod(
            EDGES,
            np.array([clamp.start(EDGES), 0.0, 0.0]),
            np.array([1.0, 0.0, 0.0]),
            np.array([0.0, 1.0, 0.0]),
            EDGES * clamp.edge(EDGES),
            RADIUS,
            DENSITY,
            youngs_modulus=YOUNGS,
        )
        simulator.append(rod)
        simulator.constrain(rod).using(ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,))
        simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=GRAVITY)
        rods.append(rod)
    simulator.finalize()
    stepper, steps, tips = ea.PositionVerlet(), step_count(dt), []

    def work():
        now = 0.0
        for k in range(steps):
            now = stepper.step(simulator, now, DURATION / steps)
            if (k + 1) % (steps // FRAMES) == 0:
                tips.append(rods[0].position_collection[:, -1].copy())

    with np.errstate(all="ignore"):
        cpu, wall = clocked(work)
    return Timed(np.array(tips), cpu, wall)


def mujoco_model(dt: float, integrator: str, edge_law: str, clamp: Clamp):
    """MuJoCo: the rope as a one-dimensional flex, masses lumped by Voronoi length."""
    import mujoco

    h, x0 = clamp.edge(EDGES), clamp.start(EDGES)
    points = " ".join(f"{x0 + i * h:.17g} 0 0" for i in range(EDGES + 1))
    elements = " ".join(f"{i} {i + 1}" for i in range(EDGES))
    edge_law = edge_law.replace("STIFFNESS", repr(YOUNGS * AREA / h))
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <option timestep="{dt!r}" integrator="{integrator}" solver="Newton" gravity="0 0 -9.81">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <flexcomp name="rope" type="direct" dim="1" point="{points}" element="{elements}"
              mass="1" radius="{RADIUS}">
      <pin id="0 1"/>
      {edge_law}
      <contact selfcollide="none" contype="0" conaffinity="0"/>
      <elasticity young="{YOUNGS}" poisson="0.4999" damping="0"/>
    </flexcomp>
  </worldbody>
</mujoco>""")
    for i in range(2, EDGES + 1):
        model.body(f"rope_{i}").mass = DENSITY * AREA * h * (0.5 if i == EDGES else 1.0)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def run_mujoco(
    dt: float,
    scenes: int = 1,
    clamp: Clamp | None = None,
    *,
    integrator: str = "discrete",
    edge_law: str = DISCRETE,
    workers: int = 1,
) -> Timed:
    """MuJoCo: one scene by mj_step, many by mujoco.batch on `workers` threads."""
    import mujoco
    from mujoco import batch

    steps = step_count(dt)
    model = mujoco_model(DURATION / steps, integrator, edge_law, clamp or Clamp())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    edge, tips, strains = (clamp or Clamp()).edge(EDGES), [], []

    def look():
        mujoco.mj_kinematics(model, data)
        mujoco.mj_flex(model, data)
        tips.append(data.flexvert_xpos[-1].copy())
        lengths = np.linalg.norm(np.diff(data.flexvert_xpos, axis=0), axis=1)
        strains.append(float(abs(lengths / edge - 1).max()))

    def work():
        for _ in range(FRAMES):
            mujoco.mj_step(model, data, steps // FRAMES)
            look()

    if scenes == 1:
        cpu, wall = clocked(work)
    else:
        many = batch.Batch(model, nsim=scenes, nthread=workers)
        many.step(nstep=1)
        many.reset()
        cpu, wall = clocked(lambda: many.step(nstep=steps))
        data = many.get_data(0)
        look()
    warnings = (mujoco.mjtWarning.mjWARN_BADQACC, mujoco.mjtWarning.mjWARN_BADQVEL)
    healthy = all(data.warning[w].number == 0 for w in warnings)  # it resets itself otherwise
    stretched = max(strains) if integrator == "discrete" else 0.0  # the other one has the stretching stiffness E A
    return Timed(np.array(tips) if healthy else np.full((1, 3), np.nan), cpu, wall, stretched)


def elastica_part(dt: float, scenes: int) -> float:
    """CPU seconds of a share of the scenes, in a worker process."""
    return run_elastica(dt, scenes).cpu


def elastica_many(dt: float, config: Config) -> dict[str, float]:
    """Speeds with many scenes: in one process, and shared among the workers."""
    one = run_elastica(dt, config.scenes)
    share = config.scenes // config.workers
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(config.workers, mp_context=context) as pool:
        list(pool.map(elastica_part, [dt] * config.workers, [1] * config.workers))  # loads
        start = time.perf_counter()
        cpu = sum(pool.map(elastica_part, [dt] * config.workers, [share] * config.workers))
        wall = time.perf_counter() - start  # includes the set-up of the rods
    done = share * config.workers * DURATION
    return {
        "many_per_cpu_s": config.scenes * DURATION / one.cpu,
        "many_workers_per_cpu_s": done / cpu,
        "many_workers_per_wall_s": done / wall,
    }


def mujoco_many(dt: float, config: Config, run: Callable[..., Timed]) -> dict[str, float]:
    """Speeds with many scenes: on one thread, and on the workers' threads."""
    one, shared = (run(dt, config.scenes, workers=k) for k in (1, config.workers))
    done = config.scenes * DURATION
    return {
        "many_per_cpu_s": done / one.cpu,
        "many_workers_per_cpu_s": done / shared.cpu,
        "many_workers_per_wall_s": done / shared.wall,
    }


def largest_stable(run: Callable[..., Timed], low: float, high: float) -> float:
    """Largest step [s] that ends within 1 mm of a small one, found by bisection to 1 per cent."""
    tip = run(low).tips[-1]
    while high / low > 1.01:
        middle = math.sqrt(low * high)
        good = np.linalg.norm(run(middle).tips[-1] - tip) < 1e-3  # false if not finite
        low, high = (middle, high) if good else (low, middle)
    return low


def curve(
    run: Callable[..., Timed], steps: list[float], target: np.ndarray, repeats: int, **options
) -> list[dict[str, float]]:
    """Error and speed of one scene per time step, smallest first, against tips (FRAMES, 3) [m]."""
    rows, finest = [], None
    for dt in sorted(steps):
        outcomes = [run(dt, **options) for _ in range(repeats)]
        tips = outcomes[0].tips
        row: dict = {"dt": DURATION / step_count(dt)}
        rows.append(row)
        row["stable"] = bool(np.isfinite(tips).all() and (abs(tips) < 1.5 * LENGTH).all())
        if not row["stable"]:
            continue
        finest = tips if finest is None else finest
        row["tip_m"] = tips[-1].tolist()
        row["tip_error_m"] = float(np.linalg.norm(tips[-1] - target[-1]))
        row["mean_tip_error_m"] = float(np.linalg.norm(tips - target, axis=-1).mean())
        row["time_step_error_m"] = float(np.linalg.norm(tips[-1] - finest[-1]))
        row["strain"] = outcomes[0].strain
        row["one_per_cpu_s"] = DURATION / min(o.cpu for o in outcomes)
        print("   ", ", ".join(f"{k} {v:.4g}" for k, v in row.items() if k != "tip_m"))
    return rows


def chosen(rows: list[dict[str, float]]) -> dict[str, float]:
    """The row of the largest step whose own error stays below half the error of a small step."""
    good = [row for row in rows if row["stable"]]
    small = good[0]["tip_error_m"]
    return dict([row for row in good if row["time_step_error_m"] <= 0.5 * small][-1])


def fastest_within(rows: list[dict[str, float]], error: str) -> list[dict[str, float]]:
    """Greatest speed with one scene for several bounds on an error [m]; none where none keeps."""
    found = []
    for bound in (0.005, 0.01, 0.015, 0.02, 0.03, 0.04):
        keep = [row for row in rows if row["stable"] and row[error] <= bound]
        if keep:
            best = max(keep, key=lambda row: row["one_per_cpu_s"])
            found.append({"bound_m": bound, "dt": best["dt"], "one_per_cpu_s": best["one_per_cpu_s"]})
    return found


def result(peer: str, method: str, target: str, clamp: Clamp, rows: list[dict]) -> dict:
    """What is reported of one method of a peer."""
    return {
        "peer": peer,
        "version": version(peer),
        "method": method,
        "target": target,
        "exact_clamp": clamp.exact,
        "chosen": chosen(rows),
        "fastest_within_tip_error": fastest_within(rows, "tip_error_m"),
        "fastest_within_mean_tip_error": fastest_within(rows, "mean_tip_error_m"),
        "curve": rows,
    }


def measure_elastica(config: Config, targets: dict[str, np.ndarray]) -> list[dict]:
    """Results of PyElastica."""
    run_elastica(1e-2)  # compiles
    limit = 1.9e-4 if config.smoke else largest_stable(run_elastica, 1e-4, 4e-4)
    steps = [limit] if config.smoke else [limit / 4, limit / 2, limit / 1.5, limit]
    method, target, results = "PositionVerlet, stretch E A", "converged_extensible", []
    for clamp in (Clamp(), Clamp(exact=True)):
        print(f"  PyElastica, {method}, {clamp}")
        rows = curve(run_elastica, steps, targets[target], config.repeats, clamp=clamp)
        results.append(result("pyelastica", method, target, clamp, rows))
        results[-1]["largest_stable_dt"] = limit
    results[0]["chosen"] |= elastica_many(results[0]["chosen"]["dt"], config)
    return results


def measure_mujoco(config: Config, targets: dict[str, np.ndarray]) -> list[dict]:
    """Results of MuJoCo: implicit and inextensible, explicit with the stretching stiffness E A."""
    explicit = '<edge stiffness="STIFFNESS"/>'
    methods = [
        ("discrete, edge equality", "discrete", DISCRETE, "converged", Clamp()),
        ("discrete, edge equality", "discrete", DISCRETE, "converged", Clamp(exact=True)),
        ("Euler, edge stiffness E A", "Euler", explicit, "converged_extensible", Clamp()),
    ]
    results = []
    for name, integrator, law, target, clamp in methods:
        print(f"  MuJoCo, {name}, {clamp}")

        def run(dt, scenes=1, clamp=clamp, integrator=integrator, law=law, **options):
            options |= {"integrator": integrator, "edge_law": law}
            return run_mujoco(dt, scenes, clamp, **options)

        steps = [1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 2.5e-3, 5e-3, 1 / 160, 1 / 120, 1e-2, 1 / 80, 1 / 60, 1 / 40]
        if integrator == "Euler":
            steps = [5e-5, 1e-4, 2.5e-4, 5e-4]  # 6.25e-4 blows up
        steps = steps[3:4] if config.smoke else steps
        rows = curve(run, steps, targets[target], config.repeats)
        results.append(result("mujoco", name, target, clamp, rows))
        results[-1]["chosen"] |= mujoco_many(results[-1]["chosen"]["dt"], config, run)
    return results


def main() -> None:
    """Measure, print and save."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--peer", default=Config.peer, choices=["all", "pyelastica", "mujoco"])
    for name in ("scenes", "workers", "repeats"):
        parser.add_argument(f"--{name}", type=count, default=getattr(Config, name))
    for name in ("reference", "json"):
        parser.add_argument(f"--{name}", default=getattr(Config, name))
    parser.flag("smoke", "few steps and scenes")
    options = vars(parser.parse_args())
    if options["smoke"]:
        options |= {"scenes": 2, "repeats": 1}
    config = Config(**options)
    with np.load(config.reference, allow_pickle=False) as file:
        every = (len(file["time"]) - 1) // FRAMES
        targets = {name: file[name][every::every, -1].astype(float) for name in ("converged", "converged_extensible")}
    measures = {"pyelastica": measure_elastica, "mujoco": measure_mujoco}
    results = []
    for name, measure in measures.items():
        if config.peer in ("all", name):
            results += measure(config, targets)
    for entry in results:
        print(entry["peer"], entry["method"], "exact clamp:", entry["exact_clamp"])
        print("   ", {k: v for k, v in entry["chosen"].items() if k not in ("tip_m", "stable")})
    if config.json:
        machine = {"cores": os.cpu_count(), "python": platform.python_version()}
        case = {"edges": EDGES, "duration_s": DURATION, "scenes": config.scenes}
        case |= {"workers": config.workers}
        content = {"machine": machine, "case": case, "results": results}
        save(config.json, content)


if __name__ == "__main__":
    main()
