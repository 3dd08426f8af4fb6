"""Fits of many numbers to films by gradient: from blurred masks back through rasteriser, camera and all steps.

What simulated and measured masks differ by, blurred over several scales, is a smooth function of every number. Its
gradient comes by the adjoint method, at a cost that does not grow with their count: segments of the motion are kept
only where they begin, and run again on the way back (`physics.execution.replay`). Broyden, Fletcher, Goldfarb and
Shanno's method with little memory (Liu and Nocedal 1989, doi:10.1007/BF01589116) goes down it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.physics import tree
from torchdlo.physics.execution.replay import rollout
from torchdlo.scene import Control, Params, Scene, State
from torchdlo.sysid.estimation.observation import by_camera, seen_by
from torchdlo.sysid.model import equilibrium
from torchdlo.sysid.video.filmed_fit import eliminated, look
from torchdlo.sysid.video.filmed_problem import FilmedProblem
from torchdlo.vision.camera import NEAR
from torchdlo.vision.rasterizer import coverage, pyramid, successors
from torchdlo.vision.spine import curve_vectors

__all__ = ["PROFILE", "descend", "picture_loss", "simulated", "whitening", "with_profile"]

Callback = Callable[[str, int, int, str], None]

PROFILE = "stiffness_profile"
"""The effect whose numbers are the stiffness along the rope."""

_MANY = 12
"""Iterations after which nothing changes."""

_SEGMENT = 10
"""Steps that are run again together."""

_LEVELS = 3
"""Scales over which masks are compared, each twice as coarse as the one before."""

_FRAMES = 16
"""Most pictures of a film that are compared."""

_PRIOR = 1e-4
"""What half a squared standard deviation costs, as a share of what it costs to see no rope at all."""

_ENOUGH = 1e-3
"""Share of the loss that a step has to save for another one to be worth while."""

_SHARP = 10.0
"""Steps of unit length change the cost of centre lines by about a share of one half of this inverse."""

_ROUGH = 0.3
"""Standard deviation of the change of a logarithm of stiffness from one place to the next one."""


def simulated(own: FilmedProblem, numbers: Tensor, *, bend: Tensor | None = None, converged: bool = False) -> Tensor:
    """Return places of the rope [m], shape (B, T, M, 3), with gradients.

    Args:
        own: the problem, whose starts stay as they are.
        numbers: all of the model's, shape (K,).
        bend: factors of the bending stiffness by vertex, shape (V,); all 1 if not given.
        converged: whether steps iterate until nothing changes. Gradients take that for granted; as fits do them, steps
            end sooner, and gradients are wrong by about 5e-5 of their size.
    """
    model, motion = own.model, own.motion
    start = own.begin(own.offset[None]) if own.offset.shape[1] else own.start
    rows: Tensor = numbers.expand(len(own.trials), -1)
    scene, params, state = model.build(motion, start, rows)  # type: ignore[arg-type]  # tensors pass with gradients
    if converged:
        scene = dataclasses.replace(scene, constraint_iterations=None, twist_iterations=_MANY)
    if bend is not None:
        rods = params.rods
        material = tree.replace(rods.material, bend=rods.material.bend * bend[:, None])
        params = tree.replace(params, rods=tree.replace(rods, material=material))
    director = model._commands(scene, state, motion)
    count = motion.markers.shape[1] - 1
    controls = [Control(motion.held[:, k], director[:, k]) for k in range(count * model.substeps + 1)]
    if start.at_rest.any():
        resting = _rest(scene, params, state, controls[0])
        state = tree.where(torch.as_tensor(start.at_rest), resting, state)
    at = list(model.marker_vertex)
    seen = state.rods.pos[None, :, at]
    if count:
        _, later = rollout(
            lambda p, s, c: scenes.step(scene, p, s, c),
            params,
            state,
            tree.stack(controls[1:]),
            segment=_SEGMENT,
            keep=lambda s: s.rods.pos[:, at],
        )
        seen = torch.cat([seen, later[model.substeps - 1 :: model.substeps]])
    out = seen.transpose(0, 1)
    known = start.discretisation_correction
    return out if known is None else out + torch.as_tensor(known[:, : out.shape[1]])


def _rest(scene: Scene, params: Params, state: State, control: Control) -> State:
    """Return the state in balance, with gradients; see `equilibrium.come_to_rest`."""
    calm, calmed, count = equilibrium.resting_scene(scene, params)
    zero = torch.zeros_like(state.rods.vel)
    begun = tree.replace(state, rods=tree.replace(state.rods, vel=zero))
    steady = tree.stack([control] * count)
    rest, _ = rollout(
        lambda p, s, c: scenes.step(calm, p, s, c), calmed, begun, steady, segment=_SEGMENT, keep=lambda s: s.time
    )
    return equilibrium.stopped(rest, state)


def picture_loss(
    own: FilmedProblem,
    numbers: Tensor,
    cameras: Tensor,
    *,
    bend: Tensor | None = None,
    scale: float = 0.5,
    converged: bool = False,
) -> Tensor:
    """Return what blurred masks of the rope differ by from those of the films, 1 for no rope at all; a scalar.

    Args:
        own: the problem.
        numbers: all of the model's, shape (K,).
        cameras: what cameras are off, shape (Q,).
        bend: factors of the bending stiffness by vertex, see `simulated`.
        scale: size of the pictures that are compared over those of the films.
        converged: see `simulated`.
    """
    sims = simulated(own, numbers, bend=bend, converged=converged)
    parts = []
    views = own.spines.views
    for view, off in zip(views, by_camera(views, cameras[None]), strict=True):
        pixel, depth, _ = seen_by(view, sims[None], off, own.spines.step)
        pixel, depth = pixel[0], depth[0]
        size = (round(view.camera.height * scale), round(view.camera.width * scale))
        for b in range(len(own.trials)):
            good = np.flatnonzero(view.good[b])
            rows = good[np.unique(np.linspace(0, len(good) - 1, _FRAMES).round().astype(int))]
            near = depth[b, rows].clamp(min=NEAR)
            wide = view.half_width * near.median() / near
            shown = _shown(pixel[b, rows], view.places[b, rows]) & (near > NEAR)
            place = (pixel[b, rows] + 0.5) * scale - 0.5
            drawn = coverage(place, wide * scale, shown, successors([pixel.shape[-2]]), size)
            masks = torch.as_tensor(view.masks(b, rows)).to(drawn)[:, None]
            measured = torch.nn.functional.interpolate(masks, size, mode="area")[:, 0]
            levels = zip(pyramid(drawn, _LEVELS), pyramid(measured, _LEVELS), strict=True)
            parts += [(a - c).square().sum() / c.square().sum().clamp(min=1e-9) for a, c in levels]
    return torch.stack(parts).mean()


def _shown(pixel: Tensor, places: np.ndarray) -> Tensor:
    """Return which of the places (F, M) of a rope are between the ends of the films' centre lines (F, S, 2)."""
    points = torch.as_tensor(places)
    with torch.no_grad():
        along = curve_vectors(pixel.double(), points.nan_to_num(1e6))[1]
    along = torch.where(torch.isfinite(points).all(-1), along, torch.nan)
    low, high = float(np.nanquantile(along, 0.005)), float(np.nanquantile(along, 0.995))
    number = torch.arange(pixel.shape[-2])
    return ((number >= low - 1) & (number <= high + 1)).expand(pixel.shape[:-1])


def with_profile(own: FilmedProblem) -> FilmedProblem:
    """Return the problem with the stiffness along the rope among its numbers."""
    factors = [f"{PROFILE}.factors.{k}" for k in range(16)]
    return own.with_effects((*own.model.effects, PROFILE), dict.fromkeys(factors, _ROUGH), factors)


def whitening(own: FilmedProblem, raw: np.ndarray) -> np.ndarray:
    """Return directions (N, N) in which centre lines are about equally sensitive, at coordinates (N,).

    Cameras move masks much more than stiffness does: down the plain gradient, steps are as short as theirs have to be.
    """
    found = look(own, raw, own.offset)
    _, curvature = eliminated(*found.normal(own.prior), found.offset.shape[1])
    size, turn = np.linalg.eigh(_SHARP / max(found.cost, 1e-6) * curvature.mean(0) + np.eye(len(raw)))
    return turn / np.sqrt(np.maximum(size, 1.0))


def descend(
    own: FilmedProblem,
    raw: np.ndarray,
    iterations: int,
    callback: Callback | None = None,
    directions: np.ndarray | None = None,
) -> np.ndarray:
    """Return coordinates (N,) of rope and cameras at which masks agree best, from given ones, by gradient.

    Args:
        own: the problem.
        raw: where to start.
        iterations: most steps.
        callback: told (stage, steps done, in all, message).
        directions: in which steps are taken, shape (N, N), see `whitening`; along each number if not given.
    """
    report = callback or (lambda *_: None)
    space, count = own.space, len(own.free)
    units = torch.as_tensor(space.units)
    logs, inverse = (torch.tensor([p.scale == scale for p in space.params]) for scale in ("log", "reciprocal"))
    profile = [k for k, name in enumerate(space.names) if name.startswith(PROFILE)]
    fixed, free = torch.as_tensor(own.fixed), torch.tensor(own.free)
    begun, ways = torch.as_tensor(raw), torch.as_tensor(np.eye(len(raw)) if directions is None else directions)
    z = torch.zeros_like(begun, requires_grad=True)

    def loss() -> Tensor:
        x = begun + ways @ z
        plain = x * units
        values = torch.where(logs, torch.exp(torch.where(logs, plain, 0.0)), plain)
        values = torch.where(inverse, 1 / torch.where(inverse, plain, 1.0), values)
        numbers = fixed.index_copy(0, free, values[:count])
        data = picture_loss(own, numbers, values[count:])
        steps = torch.diff(x[profile]) if len(profile) > 1 else x[:0]
        # The mean of the profile is the uniform stiffness's.
        mean = x[profile].mean() if profile else x.new_zeros(())
        # In units of the prior: line searches take small numbers for none.
        return data / _PRIOR + 0.5 * (x[count:].square().sum() + steps.square().sum() + 100 * mean.square())

    descent = torch.optim.LBFGS([z], max_iter=1, history_size=12, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        descent.zero_grad()
        value = loss()
        value.backward()
        return value

    best, before = begun, float("inf")
    for k in range(iterations):
        here = float(descent.step(closure).detach())  # before the step
        report("following the gradient of masks", k + 1, iterations, f"{_PRIOR * here:.5f}")
        if not np.isfinite(here) or not torch.isfinite(z).all():
            break
        best = begun + ways @ z.detach()
        if before - here < _ENOUGH * here:
            break
        before = here
    return np.asarray(space.clip(best.numpy()))
