"""What frames of a run say of mechanics: tension, curvature, moments, contact, energies."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from torchdlo import measures, scene, scene_files
from torchdlo.scene_files import Attachment, BodySpec, RopeSpec, SceneDescription
from torchdlo.scene_files.run import load_frames, run, save_frames

G = 9.81
HUNG = SceneDescription(
    (RopeSpec(((0.0, 0.0, 0.2), (0.0, 0.0, 0.0)), vertices=6, mass=0.05, bend=1e-4),),
    {"gravity": {}, "bend": {}, "damping": {"rate": 20.0}},
    attachments=(Attachment((0,)),),
    duration=0.06,
    dt=2e-3,
    substeps=1,
    integrator="implicit",
)


def test_frames_say_what_measures_do():
    rope = RopeSpec(
        ((0.0, 0.0, 0.0), (0.1, 0.05, 0.0), (0.2, 0.0, 0.0), (0.3, 0.05, 0.1)),
        mass=0.05,
        bend=1e-3,
        twist=1e-3,
        initial_twist=2.0,
        radius=0.002,
    )
    effects = {"gravity": {}, "bend_frame": {}, "twist": {}, "damping": {}}
    d = dataclasses.replace(HUNG, ropes=(rope,), effects=effects, twist="quasistatic", duration=0.02)
    d = dataclasses.replace(d, attachments=(Attachment((0, 1), edges=(0,)), Attachment((-1,), edges=(-1,))))
    frames = run(d, frame_stride=5)
    made = scene_files.assemble(d)
    world, params, state = made.scene, made.params, made.state
    control = made.plan.follow(world)
    for k in range(10):
        if k % 5 == 0:
            given, f = (world, params, state), k // 5
            for name, measure in (("tension", measures.tension), ("twist_density", measures.twist)):
                np.testing.assert_allclose(getattr(frames, name)[f], measure(*given)[:, 0], rtol=1e-6, atol=1e-9)
            for name in ("curvature", "bending_moment"):
                found = getattr(measures, name)(*given)
                np.testing.assert_allclose(getattr(frames, name)[f], found, rtol=1e-6, atol=1e-9)
            for name in ("kinetic_energy", "gravitational_energy", "bending_energy", "twisting_energy"):
                assert getattr(frames, name)[f] == pytest.approx(float(getattr(measures, name)(*given)), rel=1e-9)
        state = scene.step(world, params, state, control(k, state))
    assert np.abs(frames.bending_energy).min() > 0 and np.abs(frames.twisting_energy).min() > 0


def test_a_hanging_rope_shows_its_tension():
    frames = run(HUNG)
    below = 0.05 * G * (np.arange(5, 0, -1) - 0.5) / 5
    assert frames.tension[-1, :5] == pytest.approx(below, rel=1e-4)
    assert not frames.contact_force.any() and frames.body_contact_force.shape == (4, 0, 3)


@pytest.mark.parametrize("steps", [{}, {"integrator": "explicit", "substeps": 5, "contact": "sweeps"}])
def test_what_lies_on_the_ground_is_carried_by_contact(steps):
    rope = RopeSpec(((0.0, 0.0, 0.005), (0.2, 0.0, 0.005)), vertices=6, mass=0.05, bend=1e-4)
    ball = BodySpec("sphere", (0.02,), pos=(0.5, 0.0, 1.0), mass=0.1)
    lying = dataclasses.replace(
        HUNG, ropes=(rope,), bodies=(BodySpec("plane", motion="fixed"), ball), attachments=(), **steps
    )
    frames = run(dataclasses.replace(lying, effects=lying.effects | {"rod_body": {}}))
    assert not frames.contact_force[0].any()
    assert frames.contact_force[-1].sum(0) == pytest.approx([0.0, 0.0, 0.05 * G], rel=0.02, abs=1e-6)
    if steps:
        assert frames.body_contact_force[-1, 0, 2] == pytest.approx(-frames.contact_force[-1].sum(0)[2], rel=1e-5)
    # The ball falls freely; its velocity is that of half a substep before.
    time = frames.time[1:] - 0.5 * lying.dt / lying.substeps
    assert frames.body_kinetic_energy[1:] == pytest.approx(0.05 * (G * time) ** 2, rel=1e-9)
    assert frames.body_gravitational_energy[0] == pytest.approx(0.1 * G)


def test_older_files_have_no_frames_of_it(tmp_path):
    frames = run(HUNG)
    save_frames(frames, tmp_path / "frames.npz")
    back = load_frames(tmp_path)
    assert all(np.array_equal(getattr(back, n), v) for n, v in vars(frames).items() if isinstance(v, np.ndarray))
    new = ("tension", "curvature", "twist_density", "bending_moment", "contact_force", "body_contact_force")
    with np.load(tmp_path / "frames.npz") as kept:
        old = {n: kept[n] for n in kept.files if n not in new and not n.endswith("_energy")}
    np.savez(tmp_path / "frames.npz", **old)
    back = load_frames(tmp_path)
    assert back.tension.shape == (0, 6) and back.contact_force.shape == (0, 6, 3) and back.kinetic_energy.shape == (0,)
    assert np.array_equal(back.pos, frames.pos) and math.isclose(back.time[-1], 0.06)


def test_frames_are_kept_of_single_precision():
    frames = run(dataclasses.replace(HUNG, precision="float32", duration=0.01))
    assert frames.tension.dtype == np.float32 and bool(torch.isfinite(torch.tensor(frames.bending_energy)).all())
