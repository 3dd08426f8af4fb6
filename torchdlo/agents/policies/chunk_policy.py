"""A policy that sees pictures, reads an instruction, and says where tools are to go in the next actions.

Pictures go through a small convolutional network whose channels the sentence scales and shifts (FiLM: Perez et al.
2018, arXiv:1709.07871); a transformer decoder asks what was seen and the sentence for a chunk of targets (Zhao et al.
2023, arXiv:2304.13705, without its latent variable). Targets are places in the world: what one action did not reach the
next one still leads to, so mistakes do not add up.

It need not be told where its arms are. Where demonstrations follow one path, arms and words alone say what comes next,
and a policy that is told both succeeds blind.
"""

from __future__ import annotations

import itertools
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchdlo.agents.policies.language import WIDTH
from torchdlo.errors import InputError
from torchdlo.files import replace_atomically
from torchdlo.untrusted.tensor_file import check_shapes, read_tensors

__all__ = ["ChunkPolicy", "NetworkShape", "is_chunk_policy", "load_policy", "save_policy"]

GENERATOR = "torchdlo learn"


@dataclass(frozen=True)
class NetworkShape:
    """What the network is like."""

    arms: int
    cameras: tuple[str, ...]
    size: int
    """Width and height of pictures [px]."""
    state: int = 0
    """Numbers of the state of all arms; 0 if it only sees."""
    chunk: int = 20
    """Actions that it looks ahead."""
    width: int = 128
    channels: tuple[int, ...] = (32, 64, 96)
    tokens: int = 2
    """Tokens that a picture becomes."""
    layers: int = 2
    heads: int = 4
    each: int = 4
    """Actions that a query of the decoder asks for."""


_STEM = (8, 4, 2)
"""Kernel, stride and margin of the first convolution [px]: coarse, as large pictures cost most there."""
_LATER = (3, 2, 1)


class _Eye(nn.Module):
    """Pictures of a camera as tokens."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        pairs = list(itertools.pairwise((3, *shape.channels)))
        kinds = [_STEM if k == 0 else _LATER for k in range(len(pairs))]
        self.layers = nn.ModuleList(nn.Conv2d(a, b, *kind) for (a, b), kind in zip(pairs, kinds, strict=True))
        self.norms = nn.ModuleList(nn.GroupNorm(8, b) for _, b in pairs)
        self.films = nn.ModuleList(nn.Linear(WIDTH, 2 * b) for _, b in pairs)
        for film in self.films:
            # At first the sentence changes nothing.
            nn.init.zeros_(film.get_parameter("weight"))
            nn.init.zeros_(film.get_parameter("bias"))
        cells = shape.size
        for kernel, stride, margin in kinds:
            cells = (cells + 2 * margin - kernel) // stride + 1
        # A weight for every place: cameras hardly move, and what counts is where things are.
        self.out = nn.Linear(shape.channels[-1] * cells * cells, shape.tokens * shape.width)
        self.tokens = shape.tokens

    def forward(self, image: Tensor, sentence: Tensor) -> Tensor:
        """Return tokens (B, n, width) of pictures (B, 3, H, W), from 0 to 255, and sentences (B, 384)."""
        x = image.to(self.out.weight.dtype) / 127.5 - 1
        for layer, norm, film in zip(self.layers, self.norms, self.films, strict=True):
            scale, shift = film(sentence)[..., None, None].chunk(2, 1)
            x = F.relu(norm(layer(x)) * (1 + scale) + shift)
        return self.out(x.flatten(1)).unflatten(1, (self.tokens, -1))


class ChunkPolicy(nn.Module):
    """The network. States and targets are scaled by statistics that it keeps with its weights."""

    state_mean: Tensor
    state_std: Tensor
    target_mean: Tensor
    target_std: Tensor

    def __init__(self, shape: NetworkShape) -> None:
        """Make it, with weights drawn from torch's generator."""
        super().__init__()
        self.shape, width = shape, shape.width
        # All wrists look alike.
        self.eyes = nn.ModuleDict({kind: _Eye(shape) for kind in dict.fromkeys(map(_kind, shape.cameras))})
        self.camera = nn.Parameter(0.02 * torch.randn(len(shape.cameras), 1, width))
        self.sentence = nn.Linear(WIDTH, width)
        self.queries = nn.Parameter(0.02 * torch.randn(-(-shape.chunk // shape.each), width))
        layer = nn.TransformerDecoderLayer(width, shape.heads, 2 * width, 0.0, batch_first=True, norm_first=True)
        self.decoder = nn.TransformerDecoder(layer, shape.layers, norm=nn.LayerNorm(width))
        self.out = nn.Linear(width, shape.each * 3 * shape.arms)
        kept = {"target": 3 * shape.arms}
        if shape.state:
            self.state = nn.Sequential(nn.Linear(shape.state, width), nn.ReLU(), nn.Linear(width, width))
            kept["state"] = shape.state
        for name, size in kept.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def forward(self, pictures: dict[str, Tensor], state: Tensor, sentence: Tensor) -> Tensor:
        """Return where tools are to go [m], shape (B, chunk, R, 3).

        Args:
            pictures: by camera, 0 to 255, shape (B, 3, H, W); one that is all black is one that is not there.
            state: of all arms, see `schema.STATE`, shape (B, S); not looked at if it only sees.
            sentence: vectors of the instructions, shape (B, 384).
        """
        found = self.scaled(pictures, state, sentence) * self.target_std + self.target_mean
        return found.unflatten(-1, (self.shape.arms, 3))

    def scaled(self, pictures: dict[str, Tensor], state: Tensor, sentence: Tensor) -> Tensor:
        """Return targets on the scale on which they are learned, shape (B, chunk, 3 R)."""
        tokens = [self.sentence(sentence)[:, None]]
        if self.shape.state:
            tokens.append(self.state((state - self.state_mean) / self.state_std)[:, None])
        tokens += [
            self._seen(name, pictures[name], sentence) + self.camera[k] for k, name in enumerate(self.shape.cameras)
        ]
        # What was seen goes into the queries, too: their first layer has something to ask with.
        queries = self.queries + torch.cat(tokens, 1).mean(1, keepdim=True)
        found = self.out(self.decoder(queries, torch.cat(tokens, 1)))
        return found.reshape(len(sentence), -1, 3 * self.shape.arms)[:, : self.shape.chunk]

    def _seen(self, name: str, picture: Tensor, sentence: Tensor) -> Tensor:
        there = (picture != 0).flatten(1).any(1)
        eye = self.eyes[_kind(name)]
        if picture.device.type != "cpu":
            # To ask how many there are would wait for the device; looking at all is cheap there.
            return torch.where(there[:, None, None], eye(picture, sentence), 0.0)
        if bool(there.all()):
            return eye(picture, sentence)
        found = self.queries.new_zeros(len(picture), self.shape.tokens, self.shape.width)
        return found.index_put((there,), eye(picture[there], sentence[there])) if bool(there.any()) else found


def _kind(camera: str) -> str:
    return camera.partition("_")[0]


_LARGE = 1 << 13
"""Weights from which on a matrix is large."""


def save_policy(path: Path, policy: ChunkPolicy, about: dict[str, Any], *, small: bool = False) -> None:
    """Write a policy to a file.

    Args:
        path: the file.
        policy: the policy.
        about: what else is to be known of it, as plain data.
        small: whether to round weights, to 16 bits, those of large matrices to 8 with a scale for each row, and to
            compress the file: a fifth of the size.
    """
    weights: dict[str, Any] = policy.state_dict()
    if small:
        weights = {name: _rounded(x) if name.endswith("weight") else x for name, x in weights.items()}
    content = {"generator": GENERATOR, "shape": asdict(policy.shape), "about": about, "weights": weights}
    with replace_atomically(path) as temporary:
        torch.save(content, temporary)
        if small:
            _compress(temporary)


def _compress(path: Path) -> None:
    """Compress the entries of a file of `torch.save`, an archive that need not be stored as it is."""
    with zipfile.ZipFile(path) as archive:
        found = {info.filename: archive.read(info) for info in archive.infolist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in found.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED, 9)


def _rounded(x: Tensor) -> Tensor | dict[str, Tensor]:
    if x.numel() < _LARGE:
        return x.half()
    scale = x.abs().amax(tuple(range(1, x.dim())), keepdim=True).clamp(min=1e-12) / 127
    return {"whole": (x / scale).round().to(torch.int8), "scale": scale}


def _exact(x: Tensor | dict[str, Tensor]) -> Tensor:
    if not isinstance(x, dict):
        return x
    if x["scale"].shape[0] != x["whole"].shape[0] or x["scale"].numel() != x["scale"].shape[0]:
        raise ValueError("scales do not fit")  # a product of other shapes may be of any size
    return x["whole"] * x["scale"]


def is_chunk_policy(path: Path) -> bool:
    """Return whether a file is a policy that sees."""
    try:
        load_policy(path)
    except InputError:
        return False
    return True


def load_policy(path: Path) -> tuple[ChunkPolicy, dict[str, Any]]:
    """Return a policy and what is known of it; files cannot run code."""
    what = "a policy of torchdlo learn"
    content = read_tensors(path, what)
    try:
        if content["generator"] != GENERATOR:
            raise ValueError
        said: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in content["shape"].items()}
        shape = NetworkShape(**said)
        if max(shape.arms, len(shape.cameras), shape.layers, len(shape.channels)) > 100:
            raise ValueError
        weights = {name: _exact(x) for name, x in content["weights"].items()}
        with torch.device("meta"):  # what the file says of itself may be of any size
            check_shapes(ChunkPolicy(shape), weights, str(path), what)
        policy = ChunkPolicy(shape)
        policy.load_state_dict(weights)
    except InputError:
        raise
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError, ArithmeticError):
        raise InputError(f"{path}: expected {what}, found something else.") from None
    return policy.eval(), content["about"]
