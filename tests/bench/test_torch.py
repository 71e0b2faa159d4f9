"""The PyTorch reference is the same networks and the same step: equal weights give equal outputs."""

from __future__ import annotations

from runpy import run_path

import jax
import numpy as np
import pytest

from cannoise_jax.physics.core.poisson_gaussian import nlf_sigma
from cannoise_jax.training.state import init_state, make_networks
from cannoise_jax.training.step import make_train_step
from tests.conftest import ROOT

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install 'cannoise-jax[torch]'")

from cannoise_jax.bench import torch_networks, torch_step  # noqa: E402
from cannoise_jax.bench.torch_layers import folded, spectral_in_order, weights  # noqa: E402

BATCH, SIDE = 2, 64
PARTS = ("generator", "encoder", "critic")


def config():
    made = run_path(str(ROOT / "configs" / "paper.py"))["get_config"]()
    made.update({"width": 1 / 16, "batch_size": BATCH})
    made.compiler = {"xla_backend_optimization_level": 0}
    return made


def batch():
    rng = np.random.default_rng(0)
    names = ("clean", "noisy", "anchor", "positive", "negative")
    data = {name: rng.uniform(0, 1, (BATCH, SIDE, SIDE, 4)).astype(np.float32) for name in names}
    data |= {name: np.full((BATCH, 4), 1e-3, np.float32) for name in ("shot", "read")}
    return data | {"camera": np.arange(BATCH, dtype=np.int32) % 2}


def pattern(clean):
    """Stands for a draw: numbers of about one that both sides can make."""
    return 1.5 * np.sin(np.arange(clean[0].size, dtype=np.float32)).reshape(clean.shape[1:])


def draw(key, clean, shot, read):
    sigma = nlf_sigma(clean, shot[:, None, None], read[:, None, None])
    return sigma * pattern(clean), sigma


def torch_draw(clean, shot, read):
    sigma = torch.sqrt(shot[:, :, None, None] * clean.clamp_min(0) + read[:, :, None, None])
    moved = np.zeros((1, *clean.permute(0, 2, 3, 1).shape[1:]), np.float32)
    return sigma * torch.tensor(pattern(moved)).permute(2, 0, 1)


@pytest.fixture(scope="module")
def start():
    """Variables away from their start, as NumPy arrays, by network."""
    state = init_state(config(), 2)
    rng = np.random.default_rng(1)
    made = {}
    for name in PARTS:
        variables = jax.tree.map(np.asarray, dict(getattr(state, name)))
        params = jax.tree.map(
            lambda p: p + 0.1 * rng.normal(size=p.shape).astype(np.float32) * (p.std() or 1),
            variables["params"],
        )
        made[name] = {"params": params, "spectral": variables["spectral"]}
    return made


def channels_first(x):
    return torch.tensor(np.moveaxis(np.asarray(x), -1, 1).copy())


def channels_last(x):
    return np.moveaxis(x.detach().numpy(), 1, -1)


def close(ours, theirs, share=1e-5):
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert np.abs(ours - theirs).max() <= share * max(1.0, np.abs(ours).max())


def test_outputs_agree(start):
    networks, data = make_networks(config()), batch()
    clean, noise = data["clean"], data["noisy"] - data["clean"]
    g, e, d = (weights(spectral_in_order(start[name])) for name in PARTS)
    latent = networks.encoder.apply(start["encoder"], data["anchor"], train=False)
    theirs = torch_networks.encoder(e, channels_first(data["anchor"]), train=False)
    close(latent, theirs.detach())
    ours = networks.generator.apply(start["generator"], clean, noise, latent, clean, train=False)
    made = torch_networks.generator(g, channels_first(clean), channels_first(noise), theirs, train=False)
    close(ours, channels_last(made))
    made = torch_networks.generator(
        folded(g), channels_first(clean), channels_first(noise), theirs, train=False
    )
    close(ours, channels_last(made))
    told = [networks.critic.apply(start["critic"], noise, clean, clean, train=False)]
    told += [torch_networks.critic(d, channels_first(noise), channels_first(clean), train=False)]
    for a, b in zip(*told, strict=True):
        close(a, channels_last(b))


def test_a_step_is_the_same(start):
    """Its losses, and Adam's first moments: the gradients through all of it."""
    options, data = config(), batch()
    # Adam's first step has the size of its rate whatever the gradient's: rounding decides signs of zeros.
    options.optimiser.critic_rate = 0.0
    state = init_state(options, 2)
    state = state._replace(**{n: jax.tree.map(np.array, start[n]) for n in PARTS})
    state = state._replace(
        average=jax.tree.map(np.array, {n: start[n]["params"] for n in ("generator", "encoder")})
    )
    keys = jax.random.split(jax.random.fold_in(state.key, state.step), options.critic_updates + 1)
    mix = np.array(jax.random.uniform(jax.random.split(keys[1], 4)[2], (BATCH,)))
    after, metrics = make_train_step(options, 2, draw)(state, data)

    theirs = torch_step.trained(*(weights(spectral_in_order(start[name])) for name in PARTS), options)
    images = ("clean", "noisy", "anchor", "positive", "negative")
    given = {n: channels_first(data[n]) for n in images} | {
        n: torch.tensor(data[n]) for n in ("shot", "read")
    }
    losses = torch_step.step(theirs, given, options, torch_draw, torch.tensor(mix))
    for name, value in losses.items():
        assert float(value) == pytest.approx(float(metrics[name]), rel=1e-4, abs=1e-5), name

    first = after.generator_optimiser.inner_states
    moments = {
        "generator": (first["generator"].inner_state[0].mu["generator"], theirs.generator_optimiser),
        "encoder": (first["encoder"].inner_state[0].mu["encoder"], theirs.generator_optimiser),
        "critic": (after.critic_optimiser[0].mu, theirs.critic_optimiser),
    }
    for name, (ours, optimiser) in moments.items():
        moved = torch_step.tensors(getattr(theirs, name).params)
        found = [optimiser.state[leaf]["exp_avg"] for leaf in moved]
        wanted = torch_step.tensors(weights({"params": jax.tree.map(np.asarray, ours)}).params)
        assert len(found) == len(wanted) > 4
        scale = max(float(w.abs().max()) for w in wanted)
        for a, b in zip(wanted, found, strict=True):
            assert float((a - b).abs().max()) <= 2e-3 * scale, name
    close(after.encoder["spectral"]["e2"]["conv"]["u"], theirs.encoder.spectral["e2"]["conv"]["u"], 1e-4)
