"""The kernel of what bodies and nodes of the grid give each other against tensor operations, with its gradients."""

from __future__ import annotations

import pytest
import torch
from material_points import DOUBLE
from meetings import SHAPES, meeting

from torchdlo.coupling import BodyMpmCoupling
from torchdlo.coupling.mpm import body_coupling_op
from torchdlo.coupling.mpm.body_coupling_effect import exchange
from torchdlo.physics import tree

pytestmark = pytest.mark.skipif(not body_coupling_op.ready("cpu", DOUBLE), reason="there is no C++ compiler")


def exchanged(names, effect, mu):
    """What one exchange gives, and the derivative of a sum of it by all that it depends on."""
    grid, nodes, _, motion, _ = meeting(names, effect, mu)

    def free(x, *fields):
        leaves = {n: getattr(x, n).detach().clone().requires_grad_() for n in fields}
        return tree.replace(x, **leaves), list(leaves.values())

    nodes, moved = free(nodes, "mass", "vel", "share")
    # Scenes, which are worked on side by side, differ: in one a node may stick where it slides in the other.
    scene = torch.tensor([1.0, 1.6], dtype=DOUBLE).reshape(2, 1, 1)
    rough = tree.replace(motion.params, mu_s=motion.params.mu_s * scene, mu_k=0.8 * motion.params.mu_s / scene)
    # Nodes that lie at the very end of a plane's reach would be at a kink.
    pos = motion.state.pos + 0.0013 * scene
    motion = tree.replace(motion, params=rough, state=tree.replace(motion.state, pos=pos))
    state, placed = free(motion.state, "pos", "quat")
    params, sized = free(motion.params, "size", "mu_s", "mu_k")
    motion, pushed = free(motion, "change", "turn", "mobility", "inverse_inertia")
    motion = tree.replace(motion, state=state, params=params)
    impulse, torque, after, lost = exchange(effect, grid, nodes, motion, (2,))
    assert not lost.any()
    both = torch.cat([1e3 * impulse.flatten(), 1e5 * torque.flatten(), after.vel.flatten()])
    weight = torch.sin(torch.arange(len(both), dtype=DOUBLE))
    leaves = [*moved, *placed, *sized, *pushed]
    return both.detach(), torch.autograd.grad((weight * both).sum(), leaves, allow_unused=True)


@pytest.mark.parametrize("names", [*([n] for n in SHAPES), ["box", "sphere"], ["mesh", "cylinder"]], ids="-".join)
@pytest.mark.parametrize(("mu", "sweeps", "room"), [(0.4, 4, 1000), (0.05, 1, 0), (5.0, 2, 0)])
def test_the_kernel_and_tensor_operations_agree_with_their_gradients(names, mu, sweeps, room, monkeypatch):
    effect = BodyMpmCoupling(sweeps=sweeps, room=room)
    found, gradient = exchanged(names, effect, mu)
    monkeypatch.setattr(body_coupling_op, "ready", lambda *_: False)
    wanted, expected = exchanged(names, effect, mu)
    torch.testing.assert_close(found, wanted, rtol=1e-10, atol=1e-12)
    some = 0
    for mine, theirs in zip(gradient, expected, strict=True):
        if theirs is None or not theirs.any():
            assert mine is None or not mine.any()
            continue
        some += 1
        assert float((mine - theirs).abs().max() / theirs.abs().max()) < 1e-9
    assert some > 6


def test_places_that_are_no_numbers_stay_so():
    effect = BodyMpmCoupling()
    grid, nodes, _, motion, _ = meeting(["box"], effect)
    pos = motion.state.pos.expand(2, 1, 3).clone()
    pos[0] = torch.nan
    motion = tree.replace(motion, state=tree.replace(motion.state, pos=pos))
    impulse, _, after, _ = exchange(effect, grid, nodes, motion, (2,))
    assert bool(impulse[0].isnan().all()) and bool(after.vel[0].isnan().any())
    assert bool(impulse[1].isfinite().all()) and bool(after.vel[1].isfinite().all())
