"""A rope whose legs wind round each other: contact is looked for where it comes near itself, and is found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.sysid.swaying import recording as swaying
from torchdlo.sysid.diagnosis import effect_library, effect_search
from torchdlo.sysid.diagnosis.findings import findings
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.recordings.self_approach import near_itself

PLACES = np.linspace(0, 0.8, 17)
GRIPPED = (np.arange(17) == 0) | (np.arange(17) == 16)
NOISE, FRAMES, STEP = 3e-4, 76, 0.02


def twirled(name: str, seed: int) -> Trial:
    """A rope that hangs between two grippers which turn round each other: its legs wind up, as its bottom lags."""
    rng, time = np.random.default_rng(seed), np.arange(FRAMES) * STEP
    markers = np.empty((FRAMES, 17, 3))
    across = np.interp(PLACES, [0.0, 0.36, 0.44, 0.8], [0.05, 0.05, -0.05, -0.05])
    down = np.minimum(np.minimum(PLACES, 0.8 - PLACES), 0.36)
    markers[:] = np.stack([across, 0 * across, -down], -1)
    turns, duration = rng.uniform(1.7, 2.2) * (1, -1)[seed % 2], rng.uniform(0.9, 1.1)
    angle = np.pi * turns * (1 - np.cos(np.pi * np.clip((time - 0.1) / duration, 0, 1)))
    markers[:, 0] = 0.05 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    markers[:, -1] = -markers[:, 0]
    return Trial(name, time, markers, PLACES, GRIPPED, None, None, np.zeros(FRAMES, bool))


def recorded(path: Path, share: float, *, vertices: int = 65, trials: int = 2) -> Recording:
    """Trials of a rope that meets itself at a share of its radius; 0: it passes through itself."""
    names = [f"train_{k}" for k in range(trials)] + ["test_0"]
    made = [twirled(name, k) for k, name in enumerate(names)]
    gravity = np.array([0, 0, -9.81])
    empty = Recording(
        path, 0.8, 0.006, 0.04, gravity, None, NOISE, None, None, False, "", tuple(made[:-1]), (made[-1],)
    )
    model = RopeModel(empty, vertices=vertices, effects=("self_contact",), substep=2.5e-3, numerical_damping=0.05)
    values = {"bending_stiffness": 5e-4, "twisting_stiffness": 4e-4, "damping_rate": 1.0, "self_contact.share": share}
    start = Start(np.stack([t.markers[0] for t in made]), np.zeros((len(made), 17, 3)), np.ones(len(made), bool))
    motion = replace(model.motion(made), markers=np.full((len(made), FRAMES, 17, 3), np.nan))
    sims = model.simulate(motion, start, np.array([[values[n] for n in model.parameters]]))[0]
    rng = np.random.default_rng(7)
    seen = [
        replace(t, markers=np.where(GRIPPED[:, None], t.markers, sim + NOISE * rng.normal(size=sim.shape)))
        for t, sim in zip(made, sims, strict=True)
    ]
    return replace(empty, train=tuple(seen[:-1]), test=(seen[-1],))


@pytest.fixture(scope="module")
def hooked(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return recorded(tmp_path_factory.mktemp("rope"), 1.0)


def test_contact_is_looked_for_where_a_rope_comes_near_itself(hooked: Recording, tmp_path: Path) -> None:
    assert near_itself(hooked) and not near_itself(replace(hooked, radius=None))
    assert not near_itself(swaying(tmp_path, frames=60))
    single = tuple(replace(t, time=t.time[:1], markers=t.markers[:1], suspect=t.suspect[:1]) for t in hooked.train)
    assert not near_itself(replace(hooked, train=single))
    # Before the grippers turn, its legs hang apart.
    early = tuple(replace(t, time=t.time[:8], markers=t.markers[:8], suspect=t.suspect[:8]) for t in hooked.train)
    assert not near_itself(replace(hooked, train=early))
    mesh = RopeModel(hooked, vertices=33).mesh
    assert effect_library.applicable("self_contact", hooked, mesh)
    assert not effect_library.applicable("self_contact", replace(hooked, train=early), mesh)
    # A model that has it can be simulated there nevertheless.
    values = {"bending_stiffness": 5e-4, "twisting_stiffness": 4e-4, "damping_rate": 1.0, "self_contact.share": 1.0}
    options = {"vertices": 33, "rest": "straight"}
    given = ModelFile(tmp_path / "model.json", ("self_contact",), values, options)
    assert "self_contact.share" in given.model(replace(hooked, train=early)).parameters


def test_a_rope_that_passes_through_itself_moves_otherwise(hooked: Recording) -> None:
    through = recorded(hooked.path, 0.0)
    apart = [np.nanmax(np.abs(a.markers - b.markers)) for a, b in zip(hooked.train, through.train, strict=True)]
    assert min(apart) > 0.03


@pytest.mark.slow
def test_contact_of_a_rope_with_itself_is_named(hooked: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effect_search, "BUDGETS", {"fast": effect_search.Budget(3, 3, 3, 3, 1)})
    looked = {"self_contact", "air_drag", "internal_friction"}
    without = [name for name in effect_library.library() if name not in looked]
    result = effect_search.diagnose(hooked, vertices=33, workers=1, without=without)
    said = findings(result, hooked)
    assert result.effects == ["self_contact"]
    assert said["effects"][0]["parameters"]["share"]["value"] == pytest.approx(1.0, abs=0.3)
