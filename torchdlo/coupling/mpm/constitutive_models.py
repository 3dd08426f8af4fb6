"""What particles of matter are made of: elastic, elastoplastic, liquid or sand.

Particles carry e = F F^T - I, the left Cauchy-Green tensor of their elastic deformation F less the identity: isotropic
laws need no more of F, and small strains keep their digits in single precision. Laws return the Kirchhoff stress, the
stress per volume that the matter had at first.

A neighbourhood that turns inside out looks like one that does not: F and F F^T differ in their determinants' sign only.
Steps that the stability check allows do not turn anything inside out.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.mpm import plastic_op
from torchdlo.coupling.mpm.symmetric_tensors import (
    PAIRS,
    Square,
    Symmetric,
    add_diagonal,
    deform,
    determinant,
    deviator,
    from_hencky,
    hencky,
    second,
    select,
    squared,
    stretch,
    trace,
)
from torchdlo.physics.effects.base import Param, Values

Answer = tuple[Symmetric, Symmetric, Tensor]
"""Kirchhoff stress [Pa], strain e [1], and what else a law remembers."""

_YOUNGS = Param(1e5, 1e2, 1e9, "Pa", "log", None, "Young's modulus.")
_POISSON = Param(0.3, 0.0, 0.49, "1", "linear", None, "Poisson's ratio.")


class ConstitutiveModel(ABC):
    """How matter answers to deformation. Subclasses are frozen dataclasses and final."""

    name: ClassVar[str]
    """Name in messages and parameter trees."""
    params: ClassVar[dict[str, Param]]
    """Its numbers."""
    density: ClassVar[Param] = Param(1000.0, 1.0, 2e4, "kg/m^3", "log", None, "Density at rest.")

    @abstractmethod
    def answer(self, numbers: Values, strain: Symmetric, history: Tensor, change: Square, dt: float) -> Answer:
        """Return stress, strain and history after a deformation.

        Args:
            numbers: its numbers, each of shape (..., N or 1).
            strain: e before, shape (..., N) each.
            history: what else it remembered, shape (..., N).
            change: by how much it is deformed, F -> (I + change) F; shape (..., N) each.
            dt: in what time [s].
        """

    def deformed(
        self, numbers: Values, strain: Tensor, history: Tensor, affine: Tensor, dt: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return stress [Pa] (..., 6, N), strain [1] (..., 6, N) and history (..., N) after velocity gradients acted.

        Args:
            numbers: its numbers, each of shape (..., N or 1).
            strain: e before, shape (..., 6, N).
            history: what else it remembered, shape (..., N).
            affine: velocity gradients, row by row [1/s], shape (..., 9, N).
            dt: how long they act [s].
        """
        # Component by component, as they are stored; so are the derivatives then.
        change = tuple(dt * row for row in affine.unbind(-2))
        stress, after, history = self.answer(numbers, strain.unbind(-2), history, change, dt)
        return (
            torch.stack(torch.broadcast_tensors(*stress), -2),
            torch.stack(torch.broadcast_tensors(*after), -2),
            history,
        )

    @abstractmethod
    def modulus(self, numbers: Values) -> Tensor:
        """Return the modulus of pressure waves [Pa], density times the square of the speed of sound."""


def lame(numbers: Values) -> tuple[Tensor, Tensor]:
    """Return Lame's constants lambda and mu [Pa]."""
    youngs, poisson = numbers["youngs"], numbers["poisson"]
    return youngs * poisson / ((1 + poisson) * (1 - 2 * poisson)), youngs / (2 * (1 + poisson))


def _wave(numbers: Values) -> Tensor:
    first, mu = lame(numbers)
    return first + 2 * mu


def _norm(s: Symmetric) -> Tensor:
    """Return the Frobenius norm; its derivative at zero is zero."""
    square = squared(s)
    none = square <= torch.finfo(square.dtype).tiny
    return torch.where(none, 0.0, torch.where(none, 1.0, square).sqrt())


def _hooke(first: Tensor, mu: Tensor, h: Symmetric) -> Symmetric:
    return add_diagonal(tuple(2 * mu * x for x in h), first * trace(h))


@dataclass(frozen=True)
class Elastic(ConstitutiveModel):
    """Fixed-corotated elasticity (Stomakhin et al. 2012, section 3.2, doi:10.2312/SCA/SCA12/025-032).

    tau = 2 mu (F - R) F^T + lambda J (J - 1) I. With the left stretch V, F = V R, the first term is 2 mu (V^2 - V):
    no rotation is needed.
    """

    name: ClassVar[str] = "elastic"
    params: ClassVar[dict[str, Param]] = {"youngs": _YOUNGS, "poisson": _POISSON}

    def answer(self, numbers: Values, strain: Symmetric, history: Tensor, change: Square, dt: float) -> Answer:
        """Return the stress of the new strain; nothing is remembered."""
        first, mu = lame(numbers)
        strain = deform(strain, change)
        s = stretch(strain)
        swelling = trace(s) + second(s) + determinant(s)  # J - 1
        shear = tuple(2 * mu * (e - x) for e, x in zip(strain, s, strict=True))
        return add_diagonal(shear, first * (1 + swelling) * swelling), strain, history

    def modulus(self, numbers: Values) -> Tensor:
        """Return lambda + 2 mu."""
        return _wave(numbers)


@dataclass(frozen=True)
class Plastic(ConstitutiveModel):
    """Hencky elasticity with von Mises yield and no hardening: putty, clay.

    tau = 2 mu dev(h) + K tr(h) I with h = log(V). Where |dev tau| > sqrt(2/3) yield_stress, dev(h) is scaled back
    (radial return; Simo 1992, doi:10.1016/0045-7825(92)90123-2). The history is the accumulated plastic strain,
    sqrt(2/3) times the sum of |change of dev(h)|.
    """

    name: ClassVar[str] = "plastic"
    params: ClassVar[dict[str, Param]] = {
        "youngs": _YOUNGS,
        "poisson": _POISSON,
        "yield_stress": Param(1e3, 1.0, 1e9, "Pa", "log", None, "Stress at which it yields in tension."),
    }

    def answer(self, numbers: Values, strain: Symmetric, history: Tensor, change: Square, dt: float) -> Answer:
        """Return the stress on or inside the yield surface."""
        first, mu = lame(numbers)
        strain = deform(strain, change)
        h = hencky(strain)
        dev = deviator(h)
        size = _norm(dev)
        most = math.sqrt(2 / 3) * numbers["yield_stress"] / (2 * mu)
        flows = size > most
        excess = torch.where(flows, size - most, 0.0)
        share = excess / torch.where(flows, size, 1.0)
        h = tuple(x - share * d for x, d in zip(h, dev, strict=True))
        strain = select(flows, from_hencky(h), strain)
        return _hooke(first, mu, h), strain, history + math.sqrt(2 / 3) * excess

    def deformed(
        self, numbers: Values, strain: Tensor, history: Tensor, affine: Tensor, dt: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return stress, strain and history after velocity gradients acted."""
        if not plastic_op.ready(strain.device.type, strain.dtype):
            return super().deformed(numbers, strain, history, affine, dt)
        return plastic_op.answer((*lame(numbers), numbers["yield_stress"]), strain, history, affine, dt)

    def modulus(self, numbers: Values) -> Tensor:
        """Return lambda + 2 mu."""
        return _wave(numbers)


@dataclass(frozen=True)
class Sand(ConstitutiveModel):
    """Dry sand: Hencky elasticity with Drucker-Prager yield (Klar et al. 2016, doi:10.1145/2897824.2925906).

    |dev tau| <= -alpha (3 lambda + 2 mu) tr(h), alpha = sqrt(2/3) 2 sin(phi) / (3 - sin(phi)), and no tension. What it
    expanded without resistance has to be pressed out before it resists again: that is its history, log of volume
    (Tampubolon et al. 2017, section 4.3.4, doi:10.1145/3072959.3073651).
    """

    name: ClassVar[str] = "sand"
    params: ClassVar[dict[str, Param]] = {
        "youngs": Param(1e5, 1e2, 1e9, "Pa", "log", None, "Young's modulus."),
        "poisson": Param(0.2, 0.0, 0.49, "1", "linear", None, "Poisson's ratio."),
        "friction_angle": Param(math.radians(30), 0.0, 1.2, "rad", "linear", None, "Angle of internal friction."),
    }

    def answer(self, numbers: Values, strain: Symmetric, history: Tensor, change: Square, dt: float) -> Answer:
        """Return the stress on or inside the cone."""
        first, mu = lame(numbers)
        sine = torch.sin(numbers["friction_angle"])
        gradient = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
        trial = hencky(deform(strain, change))
        volume = trace(trial) + history
        h = add_diagonal(trial, history / 3)
        dev = deviator(h)
        size = _norm(dev)
        pressed = volume < 0
        most = -gradient * (3 * first + 2 * mu) / (2 * mu) * volume
        slides = size > most
        share = torch.where(pressed & slides, most / torch.where(slides, size, 1.0), 1.0)
        share = torch.where(pressed, share, 0.0)
        left = torch.where(pressed, volume, 0.0)
        h = add_diagonal(tuple(share * d for d in dev), left / 3)
        return _hooke(first, mu, h), from_hencky(h), volume - left

    def modulus(self, numbers: Values) -> Tensor:
        """Return lambda + 2 mu."""
        return _wave(numbers)


@dataclass(frozen=True)
class Liquid(ConstitutiveModel):
    """Weakly compressible liquid: Tait's equation of state p = bulk / n (J^-n - 1), n = 7, and viscosity.

    Monaghan 1994, doi:10.1006/jcph.1994.1034. J, the volume over that at rest, is its history, less 1. Pressure may be
    negative: the liquid holds together. `bulk` far below the real 2.2 GPa allows long steps; it has to be well above
    density times the square of the greatest speed, and above the greatest pressure.
    """

    exponent: int = 7
    """How fast it stiffens, n."""

    name: ClassVar[str] = "liquid"
    params: ClassVar[dict[str, Param]] = {
        "bulk": Param(1e5, 1e2, 1e10, "Pa", "log", None, "Bulk modulus at rest."),
        "viscosity": Param(0.0, 0.0, 1e3, "Pa s", "linear", 0.0, "Dynamic viscosity."),
    }

    def answer(self, numbers: Values, strain: Symmetric, history: Tensor, change: Square, dt: float) -> Answer:
        """Return the pressure of the new volume; strain stays as it is."""
        volume = (1 + history) * (change[0] + change[4] + change[8]) + history
        inverse = 1 / (1 + volume)
        pressure = numbers["bulk"] / self.exponent * (inverse**self.exponent - 1)
        rub = numbers["viscosity"] * (1 + volume) / dt
        tau = tuple(rub * (change[3 * i + j] + change[3 * j + i]) for i, j in PAIRS)
        return add_diagonal(tau, -(1 + volume) * pressure), strain, volume

    def modulus(self, numbers: Values) -> Tensor:
        """Return the bulk modulus."""
        return numbers["bulk"]
