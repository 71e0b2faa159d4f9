"""One training step of the literal networks in PyTorch, for comparison only: `training.step` with the losses
of configs/paper.py. E runs once a step, on anchors, positives and negatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from cannoise_jax.bench.torch_layers import Weights
from cannoise_jax.bench.torch_networks import critic, encoder, generator

Draw = Callable[[Any, Any, Any], Any]
"""(clean, shot, read) -> initial noise, `[b, 4, h, w]`."""


class Trained(NamedTuple):
    """What training changes."""

    generator: Weights
    encoder: Weights
    critic: Weights
    generator_optimiser: torch.optim.Adam
    critic_optimiser: torch.optim.Adam
    average: list[Any]


def tensors(tree: dict[str, Any]) -> list[Any]:
    """The leaves of nested dictionaries."""
    leaves = []
    for value in tree.values():
        leaves += tensors(value) if isinstance(value, dict) else [value]
    return leaves


def trained(g: Weights, e: Weights, d: Weights, config: Any) -> Trained:
    """The state before the first step."""
    options = config.optimiser
    for w in (g, e, d):
        for leaf in tensors(w.params):
            leaf.requires_grad_(True)
    betas = (options.beta1, options.beta2)
    rates = ((g, options.generator_rate), (e, options.encoder_rate))
    both = torch.optim.Adam([{"params": tensors(w.params), "lr": rate} for w, rate in rates], betas=betas)
    one = torch.optim.Adam(tensors(d.params), options.critic_rate, betas)
    kept = [leaf.detach().clone() for w in (g, e) for leaf in tensors(w.params)]
    return Trained(g, e, d, both, one, kept)


def poisson_gaussian(clean, shot, read):
    """Initial noise of a noise level function."""
    sigma = torch.sqrt(shot[:, :, None, None] * clean.clamp_min(0) + read[:, :, None, None])
    return sigma * torch.randn_like(clean)


def step(
    state: Trained, batch: dict[str, Any], config: Any, draw: Draw = poisson_gaussian, mix: Any = None
) -> dict[str, Any]:
    """Updates the state in place; returns the losses. mix: `[b]`, where between real and fake the penalty is
    taken; drawn where it is None."""
    weights, clean = config.loss, batch["clean"]
    real = batch["noisy"] - clean
    count = len(clean)
    seen = torch.cat([batch[name] for name in ("anchor", "positive", "negative")])
    anchor, latent, other = encoder(state.encoder, seen, train=True, keep=True).split(count)

    with torch.no_grad():
        n_init = draw(clean, batch["shot"], batch["read"])
        fake = generator(state.generator, clean, n_init, latent, train=False)
    weight = torch.rand(count) if mix is None else mix
    between = (real + weight[:, None, None, None] * (fake - real)).requires_grad_(True)
    scores = critic(state.critic, torch.cat([real, fake]), torch.cat([clean, clean]), train=True, keep=True)[
        0
    ]
    wasserstein = scores[count:].mean() - scores[:count].mean()
    inside = critic(state.critic, between, clean, train=False)[0]
    slope = torch.autograd.grad(inside.sum(), between, create_graph=True)[0].flatten(1)
    square = slope.square().sum(1)
    positive = square > 0
    norm = torch.where(positive, torch.where(positive, square, 1.0).sqrt(), 0.0)
    penalty = (norm - weights.slope).square().mean()
    state.critic_optimiser.zero_grad()
    (wasserstein + weights.penalty * penalty).backward()
    state.critic_optimiser.step()

    n_init = draw(clean, batch["shot"], batch["read"])
    made = generator(state.generator, clean, n_init, latent, train=True, keep=True)
    frozen = Weights(_detached(state.critic.params), state.critic.spectral)
    scores, features = critic(frozen, made, clean, train=False)
    target = clean if weights.feature_target == "clean" else real
    with torch.no_grad():
        wanted = critic(frozen, target, clean, train=False)[1]
    terms = {
        "adversarial": -scores.mean(),
        "feature_matching": (features - wanted).abs().mean(),
        "triplet": triplet(anchor, latent, other, weights.margin),
    }
    state.generator_optimiser.zero_grad()
    total = sum(weights[name] * value for name, value in terms.items())
    total.backward()  # type: ignore[union-attr]
    state.generator_optimiser.step()
    with torch.no_grad():
        leaves = [leaf for w in (state.generator, state.encoder) for leaf in tensors(w.params)]
        torch._foreach_lerp_(state.average, leaves, 1.0 - config.ema)
    named = {f"generator/{name}": value.detach() for name, value in terms.items()}
    return {"critic/wasserstein": -wasserstein.detach(), "critic/penalty": penalty.detach(), **named}


def triplet(anchor, positive, negative, margin: float):
    """Mean of max(|a - p| - |a - n| + margin, 0)."""
    near, far = (torch.linalg.vector_norm(anchor - other, dim=1) for other in (positive, negative))
    return (near - far + margin).clamp_min(0).mean()


def _detached(tree: dict[str, Any]) -> dict[str, Any]:
    return {n: _detached(v) if isinstance(v, dict) else v.detach() for n, v in tree.items()}
