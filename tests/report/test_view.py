"""The viewer: it serves its page, and what it shows follows the slider and the clock."""

from __future__ import annotations

import time
import urllib.request

import numpy as np
import pytest

from torchdlo.scene_files import Attachment, BodySpec, GridSpec, Keyframe, ParticleBlockSpec, RopeSpec, SceneDescription
from torchdlo.scene_files.run import run

pytest.importorskip("viser", reason="the viewer needs the extra view")
from torchdlo.report.viewer.server import Viewer


@pytest.fixture(scope="module")
def viewer():
    rope = RopeSpec(((0.0, 0.0, 0.5), (0.4, 0.0, 0.5)), vertices=5, mass=0.03, bend=1e-3)
    ball = BodySpec(
        "sphere",
        (0.05,),
        pos=(0.2, 0.0, 0.2),
        motion="kinematic",
        keyframes=(Keyframe(0.05, move=(0.2, 0.0, 0.0), turn=(0.0, 0.0, 1.0)),),
    )
    described = SceneDescription(
        (rope,),
        {"bend": {}, "gravity": {}, "table": {"height": 0.0}},
        bodies=(ball,),
        attachments=(Attachment((0,)),),
        material_points=(ParticleBlockSpec("sand", (0.02,), 0.01, "ball", (0.0, 0.0, 0.1)),),
        box=GridSpec((-0.1, -0.1, 0.0), (0.1, 0.1, 0.2), 0.02),
        duration=0.05,
    )
    made = Viewer(run(described), title="a run", port=18080)
    yield made
    made.stop()


def wait(condition, seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.01)


def test_it_serves_a_page(viewer):
    with urllib.request.urlopen(viewer.address, timeout=300) as answer:
        assert answer.status == 200 and b"<html" in answer.read()


def test_what_is_shown_follows_the_slider(viewer):
    frames = viewer.frames
    for k in (5, 2):
        viewer.slider.value = k
        wait(lambda k=k: viewer.frame == k)
        rope, ball = viewer._drawn
        # The last corner of a tube is the end of the rope; the page gets single precision.
        assert np.abs(rope.vertices[-1] - frames.pos[k, -1]).max() < 1e-6
        assert np.abs(ball.position - frames.body_pos[k, 0]).max() < 1e-6
        assert min(np.abs(ball.wxyz - s * frames.body_quat[k, 0]).max() for s in (1, -1)) < 1e-6
        assert np.abs(viewer._clouds[0].points - frames.material_points[k]).max() < 1e-6
        assert viewer._label.value == f"{frames.time[k]:.3f} s"


def test_it_plays_from_where_it_is_starts_again_at_the_end_and_pauses(viewer):
    viewer.slider.value = 4
    viewer.speed.value = 0.05
    viewer.playing.value = True
    wait(lambda: viewer.frame == 5)
    wait(lambda: viewer.frame == 0)
    viewer.playing.value = False

    def stands() -> bool:
        still = viewer.frame
        time.sleep(0.5)
        return viewer.frame == still

    wait(stands)  # what was on its way arrives first


def test_the_command_serves_a_run_until_ctrl_c(tmp_path, monkeypatch, viewer):
    from torchdlo.cli import scenes as commands
    from torchdlo.report.viewer import server as view
    from torchdlo.scene_files.run import save_frames

    save_frames(viewer.frames, tmp_path / "frames.npz", SceneDescription((), {}))
    seen = []

    def interrupt(self):
        with urllib.request.urlopen(self.address, timeout=300) as answer:
            seen.append(answer.status)
        raise KeyboardInterrupt

    monkeypatch.setattr(view.Viewer, "_until_interrupted", interrupt)
    with pytest.raises(SystemExit) as ended:
        commands.view(tmp_path, port=18090)
    assert seen == [200] and ended.value.code == 130
