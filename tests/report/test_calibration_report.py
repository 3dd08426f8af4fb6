"""The report page says what happened, needs no other file, and survives odd results."""

from __future__ import annotations

import base64
import dataclasses
import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.fake_calibration import fake_result
from torchdlo.report import write_report
from torchdlo.report.figures.calibration_figure import calibration_png
from torchdlo.report.pages.calibration import calibration_html, calibration_verdict
from torchdlo.sysid import Recording, load_recording


@pytest.fixture(scope="module")
def recording(template: Path) -> Recording:
    return load_recording(template)


def test_verdict_names_before_after_and_what_to_beat(recording: Recording) -> None:
    result = fake_result(
        recording,
        before={"train_mae_mm": 9.0, "test_mae_mm": 20.04},
        test_mae_mm=5.06,
        baselines={"frozen_shape": {"test_mae_mm": 31.8}, "catenary": {"test_mae_mm": 20.5}},
    )
    assert calibration_verdict(result, recording) == (
        "Calibrated on 2 trials; error on unseen trials 20.0 mm → 5.1 mm (frozen shape 31.8 mm, catenary 20.5 mm)."
    )


def test_verdict_does_not_sell_a_bad_model(recording: Recording) -> None:
    worse = fake_result(recording, test_mae_mm=1e3)
    assert "do not use this" in calibration_verdict(worse, recording)
    broken = fake_result(recording, test_mae_mm=float("nan"))
    assert "do not use this" in calibration_verdict(broken, recording)
    useless = fake_result(recording, before={"train_mae_mm": 0.1, "test_mae_mm": 0.1})
    assert "did not help" in calibration_verdict(useless, recording)
    assert "interrupted" in calibration_verdict(fake_result(recording, interrupted=True), recording)


def test_page_is_self_contained(recording: Recording, tmp_path: Path) -> None:
    page, picture = write_report(
        fake_result(recording), recording, tmp_path / "new", command="torchdlo calibrate 'a b'"
    )
    text = page.read_text()
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert base64.b64encode(picture.read_bytes()).decode() in text
    assert text.index("Calibrated on 2 trials") < text.index("<img")
    assert "<td>bending stiffness</td><td>0.0005</td><td>0.0004 to -</td><td>N m^2</td>" in text
    assert "torchdlo calibrate &#x27;a b&#x27;" in text
    assert sorted(p.name for p in page.parent.iterdir()) == ["report.html", "report.png"]


def test_page_escapes_what_users_name(recording: Recording) -> None:
    named = dataclasses.replace(recording, path=Path("<script>alert(1)<"))
    text = calibration_html(fake_result(recording, notes=["a<b"]), named, b"", command="<x>")
    assert "<script" not in text and "a&lt;b" in text and "&lt;x&gt;" in text


def test_picture_survives_odd_results(recording: Recording) -> None:
    result = fake_result(recording)
    blown = {name: np.full_like(p, np.nan) for name, p in result.predictions.items()}
    huge = {name: p * 1e12 for name, p in result.predictions.items()}
    one = dataclasses.replace(recording, test=recording.test[:1], gravity=np.zeros(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for strange in (
            dataclasses.replace(result, predictions=blown, test_mae_mm=float("nan")),
            dataclasses.replace(result, predictions_before=huge),
        ):
            for rope in (recording, one):
                assert calibration_png(strange, rope).startswith(b"\x89PNG")
