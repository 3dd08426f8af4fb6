"""The policy: sentences, the network, training from a set, closed loop. Its success on tasks is in docs/datasets.md."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow", reason="data sets need the extra dataset")
pytest.importorskip("av", reason="data sets need the extra dataset")
pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")

sys.path.insert(0, str(Path(__file__).parents[1] / "data"))

from short_task import SHORT, Dots, plan

from torchdlo import envs
from torchdlo.agents.data import check_dataset, open_set, sentences
from torchdlo.agents.data.making import make_dataset
from torchdlo.agents.data.record import Noise, draw_starts, play_batch
from torchdlo.agents.policies import chunk_frames, chunk_rollout, language
from torchdlo.agents.policies.chunk_policy import ChunkPolicy, NetworkShape, load_policy, save_policy
from torchdlo.agents.policies.chunk_rollout import PolicyDemonstrator, evaluate_chunk_policy
from torchdlo.agents.policies.chunk_training import Training, train_chunk_policy
from torchdlo.cli import app
from torchdlo.envs.core import episode
from torchdlo.errors import InputError

SHAPE = NetworkShape(
    arms=2, cameras=("front", "wrist_right", "wrist_left"), size=32, state=30, chunk=5, width=32, heads=2
)


@pytest.fixture(autouse=True)
def _short_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, kind in SHORT.items():
        monkeypatch.setitem(envs.TASKS, name, kind)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight episodes with pictures."""
    out = tmp_path_factory.mktemp("sets") / "small"
    envs.TASKS.update(SHORT)
    make_dataset(plan(episodes=8), out, painter=Dots())
    return out


@pytest.fixture(scope="module")
def learned(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that was trained for a while."""
    out = tmp_path_factory.mktemp("policies") / "policy.pt"
    train_chunk_policy(
        data, out, Training(epochs=60, batch=8, rate=2e-3, chunk=4, width=32, language="hashed", recolor=0.0)
    )
    return out


def test_sentences_that_mean_the_same_are_near_each_other() -> None:
    if language.default_encoder() != "minilm":
        pytest.skip("the language model is not installed")
    near, far = (
        ("Coil the rope around the cone.", "Wind the cord about the cone."),
        ("Coil the rope around the cone.", "Shoot the ball at the cube."),
    )
    a, b = (language.encode_sentences(pair, "minilm") for pair in (near, far))
    assert torch.allclose(a.norm(dim=1), torch.ones(2)) and float(a[0] @ a[1]) > 0.6 > 0.4 > float(b[0] @ b[1])


def test_the_language_model_gives_the_vectors_of_its_authors() -> None:
    if language.default_encoder() != "minilm":
        pytest.skip("the language model is not installed")
    # The first numbers of model.encode("This is an example sentence") as its model card's example prints them.
    (found,) = language.encode_sentences(["This is an example sentence"], "minilm")
    assert torch.allclose(found[:3], torch.tensor([0.06765693, 0.06349581, 0.0487131]), atol=2e-5)


def test_hashed_sentences_share_what_their_words_share() -> None:
    a, b, c = language.encode_sentences(["Coil the rope left!", "coil the ROPE, left", "lift both rings"], "hashed")
    assert torch.allclose(a, b) and abs(float(a @ c)) < 0.3 and float(a.norm()) == pytest.approx(1)
    with pytest.raises(InputError, match="expected one of minilm, hashed, given 'clip'"):
        language.encode_sentences(["x"], "clip")


def test_targets_depend_on_pictures_state_and_words() -> None:
    torch.manual_seed(0)
    policy = ChunkPolicy(SHAPE)
    for eye in policy.eyes.values():
        torch.nn.init.normal_(eye.films[0].weight, std=0.1)
    given = {
        "pictures": {name: torch.randint(256, (3, 3, 32, 32), dtype=torch.uint8) for name in SHAPE.cameras},
        "state": torch.randn(3, 30),
        "sentence": torch.randn(3, 384),
    }
    usual = policy(**given)
    assert usual.shape == (3, 5, 2, 3)
    # One of a batch is as alone.
    alone = policy({n: x[1:2] for n, x in given["pictures"].items()}, given["state"][1:2], given["sentence"][1:2])
    assert torch.allclose(usual[1:2], alone, atol=1e-5)
    for name in SHAPE.cameras:
        black = given["pictures"] | {name: torch.zeros(3, 3, 32, 32, dtype=torch.uint8)}
        assert not torch.allclose(policy(**given | {"pictures": black}), usual, atol=1e-4)
    assert not torch.allclose(policy(**given | {"state": given["state"] + 1}), usual, atol=1e-4)
    assert not torch.allclose(policy(**given | {"sentence": -given["sentence"]}), usual, atol=1e-4)


def test_a_policy_on_another_device_never_waits_to_be_told_what_is_there() -> None:
    # Tensors of the device "meta" have no values: whoever asks for one fails.
    policy = ChunkPolicy(SHAPE).to("meta")
    shots = {name: torch.zeros(3, 3, 32, 32, dtype=torch.uint8, device="meta") for name in SHAPE.cameras}
    found = policy(shots, torch.zeros(3, 30, device="meta"), torch.zeros(3, 384, device="meta"))
    assert found.shape == (3, 5, 2, 3)


def test_frames_on_a_device_are_those_in_the_file(data: Path, tmp_path: Path) -> None:
    frames = chunk_frames.read_frames(open_set(data), "hashed", tmp_path, lambda *_: None)
    at, none = torch.tensor([3, 0, 17, 31]), torch.device("cpu")
    usual = vars(frames.batch(at, 4, torch.Generator()))
    shots = usual.pop("shots")
    for room, held in ((1 << 40, torch.Tensor), (0, np.ndarray)):
        moved = frames.on(none, room)
        assert all(isinstance(x, held) for x in moved.pictures.values())
        rest = vars(moved.batch(at, 4, torch.Generator()))
        seen = rest.pop("shots")
        assert all(torch.equal(x, rest[name]) for name, x in usual.items())
        assert seen.keys() == shots.keys() and all(torch.equal(seen[name], shots[name]) for name in shots)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_training_on_a_gpu_comes_to_the_same_losses(data: Path, tmp_path: Path) -> None:
    losses = []
    for device in ("cpu", "cuda"):
        training = Training(epochs=3, batch=8, chunk=4, width=32, language="hashed", recolor=0.0, device=device)
        losses.append(train_chunk_policy(data, tmp_path / f"{device}.pt", training)["loss"])
    # Convolutions are rounded to 10 bits there.
    assert np.allclose(*losses, rtol=0.05)
    assert load_policy(tmp_path / "cuda.pt")[0].queries.device.type == "cpu"


def test_files_of_policies_come_back_and_others_are_refused(tmp_path: Path) -> None:
    policy = ChunkPolicy(SHAPE)
    save_policy(tmp_path / "policy.pt", policy, {"tasks": ["short"]})
    again, about = load_policy(tmp_path / "policy.pt")
    assert again.shape == SHAPE and about == {"tasks": ["short"]}
    assert all(torch.equal(a, b) for a, b in zip(policy.parameters(), again.parameters(), strict=True))
    (tmp_path / "other.pt").write_bytes(b"something")
    torch.save({"weights": 1}, tmp_path / "third.pt")
    for name in ("other.pt", "third.pt"):
        with pytest.raises(InputError, match="expected a policy of torchdlo learn, found something else"):
            load_policy(tmp_path / name)
    with pytest.raises(InputError, match="expected a policy of torchdlo learn, found none"):
        load_policy(tmp_path / "none.pt")


def test_small_files_hold_nearly_the_same_policy(tmp_path: Path) -> None:
    torch.manual_seed(0)
    shape = NetworkShape(arms=2, cameras=("front",), size=96)
    policy = ChunkPolicy(shape).eval()
    for name, small in (("whole", False), ("small", True)):
        save_policy(tmp_path / f"{name}.pt", policy, {}, small=small)
    sizes = [(tmp_path / f"{name}.pt").stat().st_size for name in ("whole", "small")]
    assert sizes[1] < 0.27 * sizes[0]
    again, _ = load_policy(tmp_path / "small.pt")
    picture, words = torch.randint(256, (8, 3, 96, 96), dtype=torch.uint8), torch.randn(8, 384)
    with torch.no_grad():
        a, b = (one({"front": picture}, words, words) for one in (policy, again))
    # Weights that are spread evenly come back off by 127^-1 / 2 = 0.4 % of their size; ten layers add up to 1.2 %.
    assert 0 < float((a - b).square().mean().sqrt()) < 0.015 * float(a.std())


def test_training_reads_the_set_and_learns_its_targets(data: Path, learned: Path) -> None:
    policy, about = load_policy(learned)
    assert about["tasks"] == ["short"] and about["loss"][-1] < 0.25 * about["loss"][0]
    assert not list(learned.parent.glob("*checkpoint*")) and not list(learned.parent.glob(".frames*"))
    found = open_set(data)
    columns = found.columns()
    shots = {
        c.rpartition(".")[2]: np.stack([next(found.pictures(k, c, 1, 1)) for k in range(8)]) for c in found.cameras
    }
    at = 4 * np.arange(8) + 1
    state = torch.as_tensor(columns["observation.state"][at])
    words = language.encode_sentences(found.tasks, "hashed").expand(8, -1)
    with torch.no_grad():
        seen = {name: torch.as_tensor(x).movedim(-1, 1) for name, x in shots.items()}
        ahead = policy(seen, state, words)
    wanted = columns["torchdlo.target"].reshape(8, 4, 7)[..., :3]
    # The chunk begins with the target of the same frame; after the end it keeps the last one.
    assert np.abs(ahead[:, 0, 0].numpy() - wanted[:, 1]).mean() < 2e-3
    assert np.abs(ahead[:, 3, 0].numpy() - wanted[:, 3]).mean() < 2e-3


def test_training_that_was_stopped_comes_to_the_same(data: Path, tmp_path: Path) -> None:
    training = Training(epochs=3, batch=16, chunk=4, width=32, language="hashed")
    train_chunk_policy(data, tmp_path / "whole.pt", training)

    def stop(stage: str, done: int, total: int, message: str) -> None:
        if stage == "learn" and done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_chunk_policy(data, tmp_path / "parts.pt", training, callback=stop)
    with pytest.raises(InputError, match="it is of another data set or training"):
        train_chunk_policy(
            data, tmp_path / "parts.pt", Training(epochs=3, batch=8, chunk=4, width=32, language="hashed"), resume=True
        )
    train_chunk_policy(data, tmp_path / "parts.pt", training, resume=True)
    (a, one), (b, other) = (load_policy(tmp_path / f"{name}.pt") for name in ("whole", "parts"))
    assert one["loss"] == other["loss"]
    assert all(torch.equal(x, y) for x, y in zip(a.parameters(), b.parameters(), strict=True))
    with pytest.raises(InputError, match="there is no checkpoint to resume"):
        train_chunk_policy(data, tmp_path / "parts.pt", training, resume=True)


def test_training_can_begin_with_the_weights_of_a_policy(data: Path, learned: Path, tmp_path: Path) -> None:
    training = Training(epochs=1, batch=8, rate=1e-9, chunk=4, width=32, language="hashed", decay=0.0)
    found = train_chunk_policy(data, tmp_path / "next.pt", training, start=learned)
    # It is as good as it was; a new one is far from it.
    assert found["loss"][0] < 2 * load_policy(learned)[1]["loss"][-1] + 0.05
    (a, _), (b, _) = load_policy(learned), load_policy(tmp_path / "next.pt")
    assert all(torch.allclose(x, y, atol=1e-6) for x, y in zip(a.parameters(), b.parameters(), strict=True))
    other = Training(epochs=1, chunk=4, width=64, language="hashed")
    with pytest.raises(InputError, match=r"its network has width 32 \(now 64\); begin with one that is alike"):
        train_chunk_policy(data, tmp_path / "other.pt", other, start=learned)


def test_learning_goes_on_from_a_policy_and_from_smaller_pictures(
    data: Path, learned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = load_policy(learned)[0].shape.size
    half, more = tmp_path / "half.pt", tmp_path / "more.pt"

    def learn(*words: object) -> int:
        with pytest.raises(SystemExit) as end:
            app.main(["learn", str(data), "--epochs", "1", *map(str, words)])
        return int(end.value.code or 0)

    assert learn("--size", size // 2, "--out", half) == learn("--from", half, "--out", more) == 0
    assert load_policy(more)[0].shape == load_policy(half)[0].shape and load_policy(half)[0].shape.size == size // 2
    capsys.readouterr()
    assert learn("--size", 2 * size, "--out", tmp_path / "big.pt") == 2
    assert f"expected a size below, given {2 * size}" in capsys.readouterr().err


def test_smaller_pictures_are_means_of_what_their_pixels_cover(data: Path, tmp_path: Path) -> None:
    (tmp_path / "small").mkdir()
    whole = chunk_frames.read_frames(open_set(data), "hashed", tmp_path, lambda *_: None)
    small = chunk_frames.read_frames(open_set(data), "hashed", tmp_path / "small", lambda *_: None, whole.size // 2)
    for name, x in whole.pictures.items():
        mean = np.asarray(x, float).reshape(*x.shape[:2], small.size, 2, small.size, 2).mean((3, 5))
        assert np.abs(np.asarray(small.pictures[name]) - mean).max() <= 0.5


def test_learning_from_a_damaged_set_is_one_sentence(data: Path, tmp_path: Path) -> None:
    for part, said in (("data", "damaged and cannot be read"), ("videos", "file-000.mp4")):
        own = tmp_path / part
        shutil.copytree(data, own)
        file = next(f for f in sorted((own / part).rglob("file-*")))
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        with pytest.raises(InputError, match=said) as caught:
            train_chunk_policy(own, tmp_path / "policy.pt", Training(epochs=1, chunk=4, width=32, language="hashed"))
        assert len(str(caught.value).splitlines()) == 1 and not list(tmp_path.glob(".frames*"))


def test_a_policy_acts_in_closed_loop_and_makes_a_set(learned: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    found = evaluate_chunk_policy(learned, ["short"], Dots(), episodes=6, conditions=("varied", "blanked"))
    rows = found["tasks"]["short"]
    # Starts on the left are done, those on the right cannot be.
    assert 0.3 <= rows["varied"]["success"] <= 1 and found["mean"]["varied"] == rows["varied"]["success"]
    assert len(rows["varied"]["episodes"]) == 6
    again = evaluate_chunk_policy(learned, ["short"], Dots(), episodes=6)
    assert again["tasks"]["short"]["varied"] == rows["varied"]
    make_dataset(plan(episodes=2, actor=str(learned), size=16), tmp_path / "set", painter=Dots())
    assert check_dataset(tmp_path / "set") == []
    assert open_set(tmp_path / "set").provenance["episodes"][0]["actions_from"] == "policy policy.pt"
    monkeypatch.setattr("torchdlo.agents.data.painting.TaskPainter", Dots)
    words = ["evaluate", str(learned), "--starts", "2", "--out", str(tmp_path), "--json"]
    with pytest.raises(SystemExit) as done:
        app.main(words)
    assert not done.value.code and '"success"' in capsys.readouterr().out
    assert json.loads((tmp_path / "evaluation.json").read_text())["episodes"] == 2
    with pytest.raises(SystemExit) as wrong:
        app.main([*words, "--film"])
    assert wrong.value.code == 2 and "it is a policy of learn" in capsys.readouterr().err
    with pytest.raises(InputError, match="swapped: the policy has learned no other task"):
        evaluate_chunk_policy(learned, ["short"], Dots(), episodes=2, conditions=("swapped",))
    with pytest.raises(InputError, match="it moves 1 arm, and pair has 2"):
        evaluate_chunk_policy(learned, ["pair"], Dots(), episodes=2)


def test_a_policy_looks_again_after_some_actions_and_follows_its_chunk_between() -> None:
    policy = ChunkPolicy(NetworkShape(arms=1, cameras=("front",), size=32, state=15, chunk=8, width=32, heads=2))
    seen: list[int] = []

    class Counting(Dots):
        def __call__(self, made, world, looks, size):
            seen.append(int(world.count[0]))
            return super().__call__(made, world, looks, size)

    task = SHORT["short"](horizon=10)
    made = episode.prepare(task, 2, execution="eager")
    actor = PolicyDemonstrator(policy.eval(), "hashed", "policy")
    with torch.no_grad():
        play_batch(made, draw_starts(task, 0, range(2)), actor, Noise(0.0), Counting())
    assert seen == [0, 8]


def test_swapped_instructions_are_those_of_what_else_the_policy_has_learned() -> None:
    (start,) = draw_starts(envs.find("coiling"), 0, [0])
    told = chunk_rollout._told(start, "coiling", ["coiling", "separation"], "swapped").told
    assert told in sentences.training_instructions("separation")
    (start,) = draw_starts(envs.find("coiling_left"), 0, [0])
    told = chunk_rollout._told(start, "coiling_left", ["coiling_left", "separation"], "swapped").told
    assert told in sentences.training_instructions("coiling_right")
