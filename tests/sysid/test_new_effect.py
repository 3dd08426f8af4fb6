"""Adding an effect that a diagnosis finds is one class and one line in a registry."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from tests.sysid.test_diagnose import make_empty, make_recording
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.effects.effect_spec import RopeEffectSpec
from torchdlo.physics.rod.kinematics import View
from torchdlo.sysid.diagnosis import effect_library, effect_search
from torchdlo.sysid.diagnosis.findings import findings
from torchdlo.sysid.model.discretisation import make_mesh
from torchdlo.sysid.model.model_file import ModelFile


@dataclass(frozen=True)
class TurningFrame(Effect):
    """The force of Coriolis: the frame in which markers were measured turns about the vertical."""

    name: ClassVar[str] = "turning_frame"
    kind: ClassVar[EffectKind] = "force"
    equation: ClassVar[str] = "f = -2 rho rate e_z x v"
    params: ClassVar[dict[str, Param]] = {
        "rate": Param(0.0, -10.0, 10.0, "rad/s", "linear", 0.0, "Rate at which the frame turns about the vertical.")
    }
    spec = RopeEffectSpec(
        lambda _: [{"rate": 0.05}],
        signed=True,
        strength=("rate",),
        confusable=("wind",),
        experiments={"wind": "repeat the motion in the opposite direction: what the frame does turns over, too"},
    )

    def loads(self, view: View, values: Values) -> Values:
        """Return the force."""
        x, y, _ = view.state.vel.unbind(-1)
        along = torch.stack([y, -x, torch.zeros_like(x)], -1)
        return {"force": 2 * values["rate"] * view.params.material.mass * along}


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> str:
    """The one line."""
    monkeypatch.setitem(EFFECTS, "turning_frame", TurningFrame)
    return "turning_frame"


def test_a_new_effect_is_in_the_library_by_being_registered(tmp_path: Path, registered: str) -> None:
    recording = make_empty(tmp_path)
    mesh = make_mesh(recording.train[0], recording.length, 31)
    assert effect_library.library()[-1] == registered and effect_library.applicable(registered, recording, mesh)
    (number,) = effect_library.numbers(registered, recording)
    assert (number.name, number.param.unit, number.off) == ("turning_frame.rate", "rad/s", 0.0)
    (dose,) = effect_library.perturbations(registered, recording, mesh, 10.0, {"bending_stiffness": 1e-3})
    assert dose.values == {"turning_frame.rate": 0.05} and dose.signed
    assert effect_library.confusable("wind", registered) and not effect_library.confusable("air_drag", registered)
    assert effect_library.separating_experiment("wind", registered).startswith("repeat")
    assert effect_library.effect_equation(registered) == TurningFrame.equation


def test_an_effect_without_a_spec_is_not_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "gravity" in EFFECTS and "gravity" not in effect_library.library()
    with pytest.raises(ValueError, match="gravity: expected an effect that a diagnosis looks for"):
        effect_library.spec("gravity")


@pytest.mark.slow
def test_a_new_effect_is_screened_fitted_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, registered: str
) -> None:
    monkeypatch.setattr(effect_search, "BUDGETS", {"fast": effect_search.Budget(3, 2, 3, 3, 1)})
    recording = make_recording(tmp_path, {"turning_frame.rate": 0.8})
    # A baseline that is nearly right keeps it short.
    values = {"bending_stiffness": 2.2e-3, "twisting_stiffness": 1.5e-3, "damping_rate": 0.6}
    options = {"vertices": 31, "rest": "straight", "numerical_damping": 0.05, "clamp_fraction": 0.0, "substep": 5e-3}
    others = ("air_drag", "point_mass")
    without = [n for n in effect_library.library() if n not in (registered, *others)]
    result = effect_search.diagnose(
        recording, workers=1, without=without, given=ModelFile(tmp_path / "model.json", (), values, options)
    )
    said = findings(result, recording)
    assert result.effects == [registered] and {c["name"] for c in said["candidates"]} >= {registered, *others}
    assert said["effects"][0]["parameters"]["rate"]["value"] == pytest.approx(0.8, rel=0.2)
    assert any(limit["name"] == registered for limit in said["detection_limits"])
