"""Simulate ropes as chains of rigid links in MuJoCo, for recordings whose answer is known. Imports nothing of torchdlo.

Three hinges with a spring each (twist, then bending about the second and the third axis) join a link to the one before,
and the rope to its clamps. The motion is MuJoCo's (joint coordinates, damping of joints implicit, a weld at a second
clamp); the laws of `laws` act on the links' centres and on the hinges' angles. Unlike a rope, such a chain bends in
places, and beside its clamps over the length of a link.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import laws
import mujoco
import numpy as np
from laws import Laws
from scenes import LEAD, Drive, Scene
from simulate import Diverged, Poses, Rope, Track, ramp
from vectors import Array, conjugate, exponential, logarithm, multiply, rotate

HEAVY = 1e4
"""Mass of clamps [kg], beside which a rope's is nothing; their motion is prescribed."""
STEP = 4e-4
"""Step to make recordings with [s]; a quarter of it changes them by 0.01 to 0.03 mm."""
IMPLICIT = 0.5
"""Implicit damping of a spring's joint, over step times stiffness."""
LOSS = 5e-4
"""Loss time of hinges that lose energy by themselves [s]: that of an implicit step of 1 ms."""
HALVINGS = 3
"""How often the step is halved where the simulation fails."""
KEPT = 4
"""Steps from one state that is kept to the next; in between it is straight."""
SETTLE, DAMPED = 4.0, 10.0
"""Time to bring a rope to rest [s], the first half of which clamps move; rate of damping meanwhile [1/s]."""


@dataclass(frozen=True)
class Chain:
    """How the rope is cut into links, and held; what `laws` reads of a `simulate.Mesh`, of links' centres."""

    links: int
    """Links that are free."""
    first: float
    """Arclength of the first hinge, where the first clamp ends [m]."""
    last: float
    """Arclength of the last hinge, or of the free end [m]."""
    both: bool
    """Whether there is a second clamp."""

    @property
    def length(self) -> float:
        """Length of a link [m]."""
        return (self.last - self.first) / self.links

    @cached_property
    def arclength(self) -> Array:
        """Arclength of the links' centres [m], (N,): what the first clamp holds, free links, what the second holds."""
        return self.first + self.length * (np.arange(self.links + 1 + self.both) - 0.5)

    @cached_property
    def step(self) -> Array:
        """Lengths of rope that bend in the hinges [m], (N - 1,)."""
        return np.full(len(self.arclength) - 1, self.length)

    @cached_property
    def share(self) -> Array:
        """Lengths of the links [m], (N,)."""
        return np.full(len(self.arclength), self.length)

    def points(self, x: Array, q: Array, arclength: Array, offset: Array) -> Array:
        """Return markers (3, F, M) on links that begin at x (3, F, N) [m] and point along the x axis of q."""
        last = len(self.arclength) - 1
        low = np.clip(np.floor((arclength - self.first) / self.length + 1e-9).astype(int) + 1, 0, last)
        along = arclength - (self.first + (low - 1) * self.length)
        beside = np.concatenate([along[None, None], np.broadcast_to(offset[1:, None, None], (2, 1, len(along)))])
        return x[..., low] + rotate(q[..., low], beside)


# MuJoCo would write a file; what fails is seen in the data.
mujoco.set_mju_user_warning(lambda _: None)


class Links:
    """One rope as a chain of links, with laws of its own."""

    def __init__(self, rope: Rope, chain: Chain, given: Laws, dt: float, loss: Array | float = 0.0) -> None:
        """Make a chain; its hinges lose energy by themselves with a loss time [s], (N - 1,), or the same for all."""
        self.rope, self.chain, self.given, self.loss = rope, chain, given, loss
        self.stretches = given.on("stretch")
        self.model = mujoco.MjModel.from_xml_string(self._describe(dt))
        self.data = mujoco.MjData(self.model)
        ids = [self.model.body(f"link{k}").id for k in range(len(chain.step))]
        self.bodies = np.array(ids)
        self.mass, self.inertia = self.model.body_mass[self.bodies], self.model.body_inertia[self.bodies]
        of = {axis: [self.model.joint(f"{axis}{k}") for k in range(len(ids))] for axis in "xyz"}
        self.angles = np.array([[j.qposadr[0] for j in of[axis]] for axis in "xyz"])
        self.hinges = np.array([[j.dofadr[0] for j in of[axis]] for axis in "xyz"])
        clamps = [self.model.joint(f"clamp{k}") for k in range(1 + chain.both)]
        self.poses = np.array([j.qposadr[0] + np.arange(7) for j in clamps])
        self.moves = np.array([j.dofadr[0] + np.arange(6) for j in clamps])
        # A clamp's spring and the hinge beside it give way one after the other.
        self.soft = np.ones((3, 1, len(ids)))
        if given.on("gripper_compliance"):
            spring = float(given.get("gripper_compliance.stiffness")[0, 0])
            stiff = np.array([rope.twisting, rope.bending, rope.bending]) / chain.length
            for k in (0, -1)[: 1 + chain.both]:
                self.soft[:, 0, k] = spring / (spring + stiff)

    def _describe(self, dt: float) -> str:
        """Return the model as MuJoCo reads it."""
        rope, chain, given = self.rope, self.chain, self.given
        h, density = chain.length, rope.mass / rope.length
        pull = float(laws.axial(given, rope)[0, 0]) / h
        place, lump = (float(given.get(f"point_mass.{k}")[0, 0]) for k in ("position", "mass"))
        turn, along = density * h * rope.radius**2 / 2, density * h * (h * h / 12 + rope.radius**2 / 4)
        parts, ends = [], ""
        for k in range(len(chain.step)):
            start, ahead = chain.first + k * h, "" if k == 0 else f'pos="{h} 0 0"'
            mass, centre, inertia = density * h, 0.5 * h, np.array([turn, along, along])
            if lump and start <= place < start + h + 1e-9:
                all_, to = mass + lump, (0.5 * h * mass + (place - start) * lump) / (mass + lump)
                inertia[1:] += mass * (to - centre) ** 2 + lump * (place - start - to) ** 2
                mass, centre, lump = all_, to, 0.0
            parts.append(
                f'<body name="link{k}" {ahead}>'
                f'<inertial pos="{centre} 0 0" mass="{mass}" diaginertia="{inertia[0]} {inertia[1]} {inertia[2]}"/>'
                + f'<joint type="slide" axis="1 0 0" stiffness="{pull}" damping="{dt * pull}"/>' * self.stretches
                + f'<joint name="x{k}" axis="1 0 0"/>'
                + f'<joint name="y{k}" axis="0 1 0"/><joint name="z{k}" axis="0 0 1"/>'
            )
            ends += "</body>"
        heavy = f'<inertial pos="0 0 0" mass="{HEAVY}" diaginertia="{HEAVY} {HEAVY} {HEAVY}"/>'
        second = weld = ""
        if chain.both:
            second = (
                f'<body name="second" pos="{chain.last - chain.first} 0 0"><freejoint name="clamp1"/>{heavy}</body>'
            )
            weld = (
                f'<equality><weld body1="second" body2="link{len(parts) - 1}" relpose="0 0 0 1 0 0 0" '
                f'solref="{2 * dt} 1" solimp="0.9999 0.9999 0.001"/></equality>'
            )
        return (
            f'<mujoco><option timestep="{dt}" gravity="0 0 0" integrator="Euler" tolerance="1e-12"/>'
            f'<worldbody><body name="first"><freejoint name="clamp0"/>{heavy}{"".join(parts)}{ends}</body>{second}'
            f"</worldbody>{weld}</mujoco>"
        )

    def run(self, poses: Poses, times: Array, kept: int, damping: float | None = None) -> Track:
        """Go on along times (S,) [s], one step apart; return where links begin at every `kept`th of them.

        With a rate of damping [1/s] it is for coming to rest: without laws that remember.
        """
        m, d, given, chain = self.model, self.data, self.given, self.chain
        rate = self.rope.damping * float(given.get("baseline.damping")[0, 0]) if damping is None else damping
        given = given if damping is None else laws.elastic(given)
        rope = replace(self.rope, damping=rate)
        x, q, v, spin, a, turn = _prescribed(poses, times)
        memory: dict[str, Array] = {}
        xs, qs, still = [], [], np.zeros((3, 1, len(chain.arclength)))
        for k, time in enumerate(times):
            if any(w.number for w in d.warning):
                raise Diverged(f"the simulation failed at {time:.3f} s; use a smaller dt")
            for c in range(1 + chain.both):
                d.qpos[self.poses[c]] = np.concatenate([x[:, c, k], q[:, c, k]])
                d.qvel[self.moves[c]] = np.concatenate([v[:, c, k], spin[:, c, k]])
                d.qfrc_applied[self.moves[c]] = HEAVY * np.concatenate([a[:, c, k], turn[:, c, k]])
            mujoco.mj_step1(m, d)
            if k % kept == 0:
                xs.append(np.concatenate([self._behind(x[:, :1, k], q[:, :1, k]), d.xpos[self.bodies].T], 1))
                qs.append(np.concatenate([q[:, :1, k], d.xquat[self.bodies].T], 1))
            kappa = d.qpos[self.angles][:, None] / chain.length
            moment = self.soft * laws.moment(given, rope, chain, kappa, still, memory, float(time))
            memory = laws.update_memory(given, kappa, memory, m.opt.timestep)
            rub, added = self._damping(given, rope, kappa, float(time), IMPLICIT if damping is None else 1.0)
            m.dof_damping[self.hinges] = rub + added
            # What is added is taken back with the velocities before the step, so that it damps nothing; a weld is not
            # stable without it, and who comes to rest may keep it.
            back = 0.0 if chain.both or damping is not None else added * d.qvel[self.hinges]
            d.qfrc_applied[self.hinges] = back - moment[:, 0]
            d.xfrc_applied[self.bodies] = self._loads(given, rope, x[:, 0, k], q[:, 0, k], float(time))
            mujoco.mj_step2(m, d)
        return Track(times[::kept], np.array(xs)[:, :, None], np.array(qs)[:, :, None])

    def _damping(self, given: Laws, rope: Rope, kappa: Array, time: float, share: float) -> tuple[Array, Array]:
        """Return the hinges' damping (3, N - 1) [N m s]: a law's, and what keeps springs stable at any step.

        That is a share of step times stiffness, of which a quarter is enough.
        """
        gradient = laws.stiffness(given, rope, self.chain, time) * np.sqrt(given.get("anisotropic_bending.ratio"))
        gradient = gradient * (1 + 3 * given.get("stiffening_bending.c") * (kappa[1:] ** 2).sum(0))
        gradient = gradient + given.get("internal_friction.moment") / given.get("internal_friction.kappa_c")
        rub = np.zeros((3, len(gradient[0])))
        rub[1:] = given.get("bending_damping.coefficient")
        gradients = np.stack([np.full_like(gradient[0], rope.twisting), gradient[0], gradient[0]])
        rub = rub + self.loss * gradients
        added = np.maximum(share * self.model.opt.timestep * gradients - rub, 0.0)
        return rub / self.chain.length, added / self.chain.length

    def _behind(self, x: Array, q: Array) -> Array:
        """Return where the link that the first clamp holds begins."""
        return x - self.chain.length * rotate(q, np.eye(3)[:, :1])

    def _loads(self, given: Laws, rope: Rope, held: Array, turned: Array, time: float) -> Array:
        """Return forces and moments on the links [N, N m], (N - 1, 6)."""
        d = self.data
        spin, root = d.cvel[self.bodies, :3], self.model.body_rootid[self.bodies]
        at = d.xipos[self.bodies]
        velocity = d.cvel[self.bodies, 3:] + np.cross(spin, at - d.subtree_com[root])
        held_at = self._behind(held[:, None], turned[:, None])[:, 0]

        def with_held(links: Array, first: Array) -> Array:
            return np.concatenate([first[:, None], links.T], 1)[:, None]

        x, q = with_held(at, held_at), with_held(d.xquat[self.bodies], turned)
        weight = np.concatenate([[0.0], self.mass])
        force = laws.force(given, rope, self.chain, weight, x, q, with_held(velocity, np.zeros(3)), time)
        inner = d.ximat[self.bodies].reshape(-1, 3, 3)
        spin = np.einsum("nji,nj->ni", inner, spin)
        drag = -rope.damping * np.einsum("nij,nj->ni", inner, self.inertia * spin)
        return np.concatenate([force[:, 0, 1:].T, drag], 1)


def _prescribed(poses: Poses, times: Array) -> tuple[Array, ...]:
    """Return positions, turns, velocities, spins in the clamps' frames, and the rates of both, (components, G, T)."""
    e = 1e-4
    (x0, q0), (x, q), (x1, q1) = (tuple(p[:, 0] for p in poses(times + k * e)) for k in (-1, 0, 1))
    back, ahead = (logarithm(multiply(conjugate(q), k)) / e for k in (q0, q1))
    return x, q, (x1 - x0) / (2 * e), 0.5 * (ahead - back), (x1 - 2 * x + x0) / e**2, (ahead + back) / e


def settle(links: Links, poses: Poses, dt: float) -> None:
    """Bring the rope to rest in the clamps' poses at time 0, from a straight line."""
    x1, q1 = (p[..., 0] for p in poses(np.zeros(1)))
    reach = np.array([0.0, links.chain.last - links.chain.first])[: x1.shape[-1]]
    begin = x1[:, :, :1] + reach * np.eye(3)[0][:, None, None]
    vector = logarithm(q1)

    def there(times: Array) -> tuple[Array, Array]:
        part = ramp(times / (0.5 * SETTLE))
        return begin[..., None] + (x1 - begin)[..., None] * part, exponential(vector[..., None] * part)

    links.run(there, np.arange(round(SETTLE / dt) + 1) * dt, 10**9, DAMPED)


def losses(variant: str, seed: int, links: int) -> Array | float:
    """Return the loss time of each hinge [s], (N,), by how a recording that hides nothing differs from a plain one."""
    if variant == "joints":
        return np.random.default_rng([seed, 16]).uniform(0.0, 2 * LOSS, links)
    return LOSS if variant == "implicit" else 0.0


def run(
    scene: Scene, trials: list[str], numbers: list[dict], links: int, dt: float, variant: str = ""
) -> tuple[Track, Chain]:
    """Simulate trials of one rope with the same laws, with steps of about `dt` [s]; time 0 is the first frame.

    A clamp that welds a strongly damped rope takes shorter steps than others do. Variants are those of `losses`.
    """
    if any(row != numbers[0] for row in numbers):
        raise ValueError("the trials' laws differ; expected the same numbers for all")
    given = Laws(numbers[:1], scene.table)
    if given.on("table_friction"):
        dt *= 0.25  # what is slow enough to stick would chatter
    for _ in range(HALVINGS):
        try:
            return _run(scene, trials, given, links, dt, variant)
        except Diverged:
            dt *= 0.5
    return _run(scene, trials, given, links, dt, variant)


def _run(scene: Scene, trials: list[str], given: Laws, links: int, dt: float, variant: str) -> tuple[Track, Chain]:
    drive, chain = Drive(scene, trials), Chain(links, scene.grip, scene.free_end, scene.grippers == 2)
    each = int(np.ceil(1 / scene.rate / dt - 1e-9))
    step = 1 / scene.rate / each
    rope = Links(scene.rope, chain, given, step, losses(variant, scene.seed, len(chain.step)))
    settle(rope, drive, step)
    begin = rope.data.qpos.copy()
    before = round(LEAD / step)
    times = (np.arange(before + round(scene.duration / step) + 1 + KEPT) - before) * step
    tracks = []
    for b in range(len(trials)):
        mujoco.mj_resetData(rope.model, rope.data)
        rope.data.qpos[:] = begin
        tracks.append(rope.run(lambda t, b=b: tuple(p[:, b : b + 1] for p in drive(t + LEAD)), times, KEPT))
    x, q = (np.concatenate([getattr(t, k) for t in tracks], 2) for k in "xq")
    return Track(tracks[0].time, x, q), chain
