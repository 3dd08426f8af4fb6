"""A policy that sees pictures, reads an instruction, and says where tools are to go in the next actions.

Pictures go through a small convolutional network whose channels the sentence scales and shifts (FiLM: Perez et al.
2018, arXiv:1709.07871); a transformer decoder asks the places of the pictures, the state of the arms and the sentence
for a chunk of targets (Zhao et al. 2023, arXiv:2304.13705, without its latent variable). Targets are places in the
world: what one action did not reach the next one still leads to, so mistakes do not add up.
"""

from __future__ import annotations

import itertools
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchdlo.agents.policies.language import WIDTH
from torchdlo.errors import InputError
from torchdlo.files import replacing
from torchdlo.untrusted.tensor_file import check_shapes, read_tensors

__all__ = ["ChunkPolicy", "Shape", "load_policy", "save_policy"]

GENERATOR = "torchdlo learn"


@dataclass(frozen=True)
class Shape:
    """What the network is like."""

    arms: int
    cameras: tuple[str, ...]
    size: int
    """Width and height of pictures [px]."""
    state: int
    """Numbers of the state of all arms."""
    chunk: int = 20
    """Actions that it looks ahead."""
    width: int = 128
    channels: tuple[int, ...] = (16, 32, 64, 96)
    layers: int = 3
    heads: int = 4


class _Eye(nn.Module):
    """Pictures of a camera as tokens."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        sizes = (3, *shape.channels)
        pairs = list(itertools.pairwise(sizes))
        self.layers = nn.ModuleList(
            nn.Conv2d(a, b, 5 if k == 0 else 3, stride=2, padding=2 if k == 0 else 1) for k, (a, b) in enumerate(pairs)
        )
        self.norms = nn.ModuleList(nn.GroupNorm(8, b) for _, b in pairs)
        self.films = nn.ModuleList(nn.Linear(WIDTH, 2 * b) for _, b in pairs)
        for film in self.films:
            # At first the sentence changes nothing.
            nn.init.zeros_(film.weight)
            nn.init.zeros_(film.bias)
        cells = -(-shape.size // 2 ** len(pairs))
        self.out = nn.Linear(sizes[-1], shape.width)
        self.place = nn.Parameter(0.02 * torch.randn(cells * cells, shape.width))

    def forward(self, image: Tensor, sentence: Tensor) -> Tensor:
        """Return tokens (B, n, width) of pictures (B, 3, H, W), 8 bits, and sentences (B, 384)."""
        x = image.to(self.place.dtype) / 127.5 - 1
        for layer, norm, film in zip(self.layers, self.norms, self.films, strict=True):
            scale, shift = film(sentence)[..., None, None].chunk(2, 1)
            x = F.relu(norm(layer(x)) * (1 + scale) + shift)
        return self.out(x.flatten(2).transpose(1, 2)) + self.place


class ChunkPolicy(nn.Module):
    """The network. States and targets are scaled by statistics that it keeps with its weights."""

    def __init__(self, shape: Shape) -> None:
        """Make it, with weights drawn from torch's generator."""
        super().__init__()
        self.shape, width = shape, shape.width
        # All wrists look alike.
        self.eyes = nn.ModuleDict({kind: _Eye(shape) for kind in dict.fromkeys(map(_kind, shape.cameras))})
        self.camera = nn.Parameter(0.02 * torch.randn(len(shape.cameras), width))
        self.state = nn.Sequential(nn.Linear(shape.state, width), nn.ReLU(), nn.Linear(width, width))
        self.sentence = nn.Linear(WIDTH, width)
        self.queries = nn.Parameter(0.02 * torch.randn(shape.chunk, width))
        layer = nn.TransformerDecoderLayer(width, shape.heads, 2 * width, 0.0, batch_first=True, norm_first=True)
        self.decoder = nn.TransformerDecoder(layer, shape.layers, norm=nn.LayerNorm(width))
        self.out = nn.Linear(width, 3 * shape.arms)
        for name, size in (("state", shape.state), ("target", 3 * shape.arms)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def forward(self, pictures: dict[str, Tensor], state: Tensor, sentence: Tensor) -> Tensor:
        """Return where tools are to go [m], shape (B, chunk, R, 3).

        Args:
            pictures: by camera, 8 bits, shape (B, 3, H, W).
            state: of all arms, see `schema.STATE`, shape (B, S).
            sentence: vectors of the instructions, shape (B, 384).
        """
        found = self.scaled(pictures, state, sentence) * self.target_std + self.target_mean
        return found.unflatten(-1, (self.shape.arms, 3))

    def scaled(self, pictures: dict[str, Tensor], state: Tensor, sentence: Tensor) -> Tensor:
        """Return targets on the scale on which they are learned, shape (B, chunk, 3 R)."""
        known = self.state((state - self.state_mean) / self.state_std)
        tokens = [known[:, None], self.sentence(sentence)[:, None]]
        for k, name in enumerate(self.shape.cameras):
            tokens.append(self.eyes[_kind(name)](pictures[name], sentence) + self.camera[k])
        queries = (self.queries + known[:, None]).expand(len(state), -1, -1)
        return self.out(self.decoder(queries, torch.cat(tokens, 1)))


def _kind(camera: str) -> str:
    return camera.partition("_")[0]


def save_policy(path: Path, policy: ChunkPolicy, about: dict[str, Any]) -> None:
    """Write a policy to a file.

    Args:
        path: the file.
        policy: the policy.
        about: what else is to be known of it, as plain data.
    """
    content = {"generator": GENERATOR, "shape": asdict(policy.shape), "about": about, "weights": policy.state_dict()}
    with replacing(path) as temporary:
        torch.save(content, temporary)


def load_policy(path: Path) -> tuple[ChunkPolicy, dict[str, Any]]:
    """Return a policy and what is known of it; files cannot run code."""
    what = "a policy of torchdlo learn"
    content = read_tensors(path, what)
    try:
        if content["generator"] != GENERATOR:
            raise ValueError
        shape = Shape(**{k: tuple(v) if isinstance(v, list) else v for k, v in content["shape"].items()})
        if max(shape.arms, len(shape.cameras), shape.layers, len(shape.channels)) > 100:
            raise ValueError
        with torch.device("meta"):  # what the file says of itself may be of any size
            check_shapes(ChunkPolicy(shape), content["weights"], str(path), what)
        policy = ChunkPolicy(shape)
        policy.load_state_dict(content["weights"])
    except InputError:
        raise
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError, ArithmeticError):
        raise InputError(f"{path}: expected {what}, found something else.") from None
    return policy.eval(), content["about"]
