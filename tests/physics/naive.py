"""The mechanisms written a second time, in NumPy float64, frame by frame: what the fast code is compared
with.

Each function is `(rng, x, p, maps, c) -> x` on what its mechanism acts on: x[T, H, W]; p the parameters;
maps the same frozen maps; c the context as a dict of float64 arrays (gain, read, black, white, mean,
step, exposure).
Mechanisms that alter the noise steps change the entries of the dict `noise` instead, see `NOISE`.
"""

import numpy as np
from scipy import stats


def _plane_steps(x, distance):
    """The four neighbours at a distance; beyond the edge, the last sample on that side of the same parity."""
    pad = 2 * distance
    period = distance  # distance 1: repeat the last sample; 2: the last of the same colour

    def padded(values, axis):
        length = values.shape[axis]
        low = [(i % period) for i in range(-pad, 0)]
        high = [length - period + (i % period) if period > 1 else length - 1 for i in range(pad)]
        if period == 2:
            low = [(i % 2) for i in range(-pad, 0)]
            high = [length - 2 + (i % 2) for i in range(pad)]
        index = low + list(range(length)) + high
        return np.take(values, index, axis=axis)

    wide = padded(padded(x, -2), -1)
    height, width = x.shape[-2:]

    def at(dy, dx):
        return wide[..., pad + dy : pad + dy + height, pad + dx : pad + dx + width]

    return at


def neighbours(x, distance):
    at = _plane_steps(x, distance)
    return [at(0, distance), at(0, -distance), at(distance, 0), at(-distance, 0)]


def _per(x, axis):
    """Shape of one number per frame and row (1), column (2), or frame (0)."""
    t, h, w = x.shape
    return {0: (t, 1, 1), 1: (t, h, 1), 2: (t, 1, w)}[axis]


def _power_law(rng, rows, length, exponent):
    """1/f noise by summing random sinusoids on twice the length: no Fourier transform, no filter."""
    n = 2 * length
    k = np.arange(n)
    cycles = np.minimum(k, n - k)
    power = np.where(cycles == 0, 1.0, cycles).astype(float) ** -exponent
    power *= n / power.sum()
    covariance = np.array([np.mean(power * np.cos(2 * np.pi * k * lag / n)) for lag in range(length)])
    lags = np.abs(np.arange(length)[:, None] - np.arange(length)[None, :])
    return rng.multivariate_normal(np.zeros(length), covariance[lags], size=rows, method="cholesky")


def _chain_of_frames(rng, frames, memory):
    rho = np.exp(-1 / memory)
    state = [rng.normal()]
    for _ in range(frames - 1):
        state.append(rho * state[-1] + np.sqrt(1 - rho**2) * rng.normal())
    return np.array(state)


def _move(x, dy, dx):
    """Linear interpolation within each colour, pixel by pixel."""
    out = np.empty_like(x)
    height, width = x.shape
    for i in range(height):
        for j in range(width):
            total = 0.0
            for a, wa in _linear(i, dy, height):
                for b, wb in _linear(j, dx, width):
                    total += wa * wb * x[a, b]
            out[i, j] = total
    return out


def _linear(i, step, length):
    whole = int(np.floor(step / 2))
    share = step / 2 - whole
    low, high = i % 2, length - 1 - (length - 1 - i % 2) % 2
    return [(min(max(i + 2 * whole, low), high), 1 - share), (min(max(i + 2 * whole + 2, low), high), share)]


def _direction(p):
    return p["shift_px"] * np.sin(p["angle"]), p["shift_px"] * np.cos(p["angle"])


def reference_error(rng, x, p, maps, c):
    sharper = x + p["blur"] * (x - sum(neighbours(x, 2)) / 4)
    moved = np.stack([_move(f, p["shift_y"], p["shift_x"]) for f in sharper[:1]])
    return moved * (1 + p["scale"]) + p["sigma_dn"] / c["gain"] * rng.normal(size=(1, *x.shape[1:])) + 0 * x


def image_lag(rng, x, p, maps, c):
    before = rng.poisson(c["mean"] / c["gain"]).astype(float)
    return (1 - p["fraction"]) * x + p["fraction"] * np.concatenate([before, x[:-1]])


def tails(x, p):
    """Pixel by pixel along the last axis: traps keep what they hold, let go of some and take their share."""
    out, n = x.copy(), x.shape[-1]
    stays = np.exp(-1 / p["length_px"])
    share = np.abs(p["fraction"]) * (1 + p["growth"] * np.linspace(-1, 1, n))
    order = range(n) if p["fraction"] > 0 else range(n - 1, -1, -1)
    held = None
    for k, i in enumerate(order):
        if held is None:
            held = share[k] * x[..., i] / (1 - stays)
            continue
        out[..., i] = (1 - share[k]) * x[..., i] + (1 - stays) * held
        held = stays * held + share[k] * x[..., i]
    return out


def rts(rng, x, p, maps, c):
    state = np.empty(x.shape)
    state[0] = rng.choice([-1.0, 1.0], size=x.shape[1:])
    for t in range(1, len(x)):
        jumps = rng.random(x.shape[1:]) < p["rate"]
        state[t] = np.where(jumps, -state[t - 1], state[t - 1])
    return x + maps["sites"] * state * p["jump_dn"] / 2 / c["gain"]


def cosmic_rays(rng, x, p, maps, c):
    hits = rng.random(x.shape) < p["rate"] * 1e-6 * c["exposure"]
    energy = hits * rng.exponential(p["charge_e"], x.shape)
    wide = np.pad(energy, ((0, 0), (0, 1), (0, 1)), mode="edge")
    return x + 0.5 * energy + 0.3 * wide[:, :-1, 1:] + 0.2 * wide[:, 1:, 1:]


def brighter_fatter(rng, x, p, maps, c):
    flow = np.zeros_like(x)
    for n in neighbours(x, 1):
        flow += p["a00"] / 8 * (x - n) * (x + n) / 2
    return x - flow


def excess_noise(rng, x, p, maps, c):
    safe = np.maximum(x, 1e-9)
    return np.where(x > 0, rng.gamma(safe / p["excess"], p["excess"]), x)


def banding(rng, x, p, maps, c):
    phase = rng.uniform(0, 2 * np.pi, (len(x), 1))
    n = np.arange(x[0].size)
    return x + p["amplitude_dn"] * np.cos(2 * np.pi * p["frequency"] * n + phase).reshape(x.shape)


def flicker(rng, x, p, maps, c):
    phase = rng.uniform(0, 2 * np.pi, (len(x), 1, 1))
    rows = np.arange(x.shape[1])[None, :, None]
    return x * (1 + p["amplitude"] * np.cos(2 * np.pi * p["frequency"] * rows + phase))


def lossy_compression(rng, x, p, maps, c):
    """Nearest of the list of codes, found by search."""
    q = 1 - p["exponent"]
    span = np.broadcast_to(c["white"] - c["black"], (1, *x.shape[1:]))[0]
    black = np.broadcast_to(c["black"], (1, *x.shape[1:]))[0]
    k = np.arange(0, 4000)
    out = np.empty_like(x)
    for i, j in np.ndindex(*x.shape[1:]):
        s = (x[:, i, j] - black[i, j]) / span[i, j]
        codes = (k * p["step_dn"] * q / span[i, j]) ** (1 / q)
        middle = ((k[:-1] + 0.5) * p["step_dn"] * q / span[i, j]) ** (1 / q)
        out[:, i, j] = black[i, j] + np.sign(s) * codes[np.searchsorted(middle, np.abs(s))] * span[i, j]
    return out


def demosaicing(rng, x, p, maps, c):
    i, j = np.indices(x.shape[1:])
    on = (i // 2 + j // 2) % 2 == 1
    return np.where(on, (1 - p["weight"]) * x + p["weight"] * sum(neighbours(x, 2)) / 4, x)


def hot_pixel_suppression(rng, x, p, maps, c):
    at = _plane_steps(x, 2)
    around = [at(dy, dx) for dy in (-2, 0, 2) for dx in (-2, 0, 2) if dy or dx]
    return (1 - p["weight"]) * x + p["weight"] * np.minimum(x, np.max(around, axis=0))


def temperature_drift(rng, x, p, maps, c):
    kelvin = p["sigma_k"] * _chain_of_frames(rng, len(x), p["memory_frames"])
    return x + p["e_per_s"] * (2 ** (kelvin / 7) - 1 + p["base"])[:, None, None]


SAMPLE = {
    "misregistration": lambda rng, x, p, m, c: _move(x[0], *_direction(p))[None] + 0 * x,
    "scene_motion": lambda rng, x, p, m, c: np.stack(
        [_move(f, *(t * d for d in _direction(p))) for t, f in enumerate(x)]
    ),
    "reference_error": reference_error,
    "flicker": flicker,
    "illumination_drift": lambda rng, x, p, m, c: x * (1 + p["sigma"] * rng.normal(size=_per(x, 0))),
    "bookkeeping": lambda rng, x, p, m, c: (
        c["black"] + p["black_dn"] + (x - c["black"]) * (1 + p["white_error"])
    ),
    "lens_shading": lambda rng, x, p, m, c: x * (1 + p["sigma"] * m["field"]),
    "prnu": lambda rng, x, p, m, c: x * (1 + p["sigma"] * m["field"]),
    "column_gain": lambda rng, x, p, m, c: x * (1 + p["sigma"] * m["field"]),
    "odd_even_column_gain": lambda rng, x, p, m, c: x * (1 + p["sigma"] * m["field"]),
    "green_imbalance": lambda rng, x, p, m, c: x * (1 + p["sigma"] * m["field"]),
    "dead_pixels": lambda rng, x, p, m, c: np.where(m["dead"] > 0, 0.0, x),
    "dark_current": lambda rng, x, p, m, c: x + p["e_per_s"],
    "amp_glow": lambda rng, x, p, m, c: x + p["e_per_s"] * m["glow"],
    "hot_pixels": lambda rng, x, p, m, c: x + p["e_per_s"] * m["heat"],
    "clock_induced_charge": lambda rng, x, p, m, c: x + p["charge_e"],
    "compensated_dark_current": lambda rng, x, p, m, c: (
        x + rng.poisson(p["e_per_s"], x.shape) - p["share"] * p["e_per_s"]
    ),
    "temperature_drift": temperature_drift,
    "brighter_fatter": brighter_fatter,
    "image_lag": image_lag,
    "smear": lambda rng, x, p, m, c: x + p["fraction"] * x.mean(axis=1, keepdims=True),
    "parallel_cti": lambda rng, x, p, m, c: np.swapaxes(tails(np.swapaxes(x, 1, 2), p), 1, 2),
    "serial_cti": lambda rng, x, p, m, c: tails(x, p),
    "crosstalk": lambda rng, x, p, m, c: (1 - p["fraction"]) * x + p["fraction"] / 4 * sum(neighbours(x, 1)),
    "cosmic_rays": cosmic_rays,
    "saturation": lambda rng, x, p, m, c: np.where(x > p["full_well_e"], p["full_well_e"], x),
    "excess_noise": excess_noise,
    "nonlinearity": lambda rng, x, p, m, c: (
        x * (1 - p["loss"] * (c["gain"] * x / (c["white"] - c["black"])) ** p["order"])
    ),
    "rts": rts,
    "dsnu": lambda rng, x, p, m, c: x + p["sigma_dn"] * m["field"] / c["gain"],
    "row_noise": lambda rng, x, p, m, c: x + rng.normal(0, p["sigma_dn"], _per(x, 1)),
    "odd_even_row_noise": lambda rng, x, p, m, c: (
        x + rng.normal(0, p["sigma_dn"], _per(x, 1)) * np.where(np.arange(x.shape[2]) % 2, -1, 1)
    ),
    "column_noise": lambda rng, x, p, m, c: x + rng.normal(0, p["sigma_dn"], _per(x, 2)),
    "row_fpn": lambda rng, x, p, m, c: x + p["sigma_dn"] * m["field"],
    "column_fpn": lambda rng, x, p, m, c: x + p["sigma_dn"] * m["field"],
    "odd_even_column_fpn": lambda rng, x, p, m, c: x + p["sigma_dn"] * m["field"],
    "pink_noise": lambda rng, x, p, m, c: (
        x + p["sigma_dn"] * _power_law(rng, len(x), x[0].size, p["exponent"]).reshape(x.shape)
    ),
    "row_pink_noise": lambda rng, x, p, m, c: (
        x + p["sigma_dn"] * _power_law(rng, len(x), x.shape[1], p["exponent"])[:, :, None]
    ),
    "banding": banding,
    "offset_drift": lambda rng, x, p, m, c: x + rng.normal(0, p["sigma_dn"], _per(x, 0)),
    "channel_offset": lambda rng, x, p, m, c: x + p["sigma_dn"] * m["field"],
    "amplifier_mismatch": lambda rng, x, p, m, c: x + p["step_dn"] * m["field"],
    "amplifier_drift": lambda rng, x, p, m, c: (
        x + np.repeat(rng.normal(0, p["sigma_dn"], (len(x), 1, 2)), x.shape[2] // 2, axis=2)
    ),
    "amplifier_gain": lambda rng, x, p, m, c: x + (x - c["black"]) * p["sigma"] * m["field"],
    "lossy_compression": lossy_compression,
    "black_clipping": lambda rng, x, p, m, c: np.where(
        x < c["black"] + p["level_dn"], c["black"] + p["level_dn"], x
    ),
    "missing_codes": lambda rng, x, p, m, c: (
        x
        + np.where((np.round(x / c["step"]) - p["phase"]) % round(p["period"]) == 0, c["step"], 0)
        * np.where(rng.random(x.shape) < p["above"], 1, -1)
        * (rng.random(x.shape) >= p["kept"])
    ),
    "demosaicing": demosaicing,
    "in_camera_denoising": lambda rng, x, p, m, c: (
        (1 - p["weight"]) * x + p["weight"] / 4 * sum(neighbours(x, 2))
    ),
    "defect_correction": lambda rng, x, p, m, c: np.where(m["sites"] > 0, sum(neighbours(x, 2)) / 4, x),
    "hot_pixel_suppression": hot_pixel_suppression,
}


def _tukey(rng, shape, tail):
    law = stats.tukeylambda(tail)
    return law.rvs(size=shape, random_state=rng) / np.sqrt(law.var())


NOISE = {
    "gain_error": lambda c, p, m: (
        c | {"gain": c["gain"] * (1 + p["error"]), "read": c["read"] / (1 + p["error"])}
    ),
    "read_noise_error": lambda c, p, m: c | {"read": c["read"] * (1 + p["error"])},
    **{
        f"{over}_read_noise_map": lambda c, p, m: c | {"read": c["read"] * m["factor"]}
        for over in ("pixel", "row", "column")
    },
    "dual_gain": lambda c, p, m: (
        c
        if c["iso"] < p["iso_switch"]
        else c | {"gain": c["gain"] * p["gain_ratio"], "read": c["read"] * p["read_ratio"]}
    ),
    "quantization": lambda c, p, m: c | {"step": p["step_dn"]},
    "heavy_tails": lambda c, p, m: c | {"tail": p["tukey_lambda"]},
    "poisson_skew": lambda c, p, m: c | {"share": p["strength"]},
}


def simulate(rng, acts_on, id, p, maps, c, frames):
    """One mechanism in the whole chain: codes [T, H, W] in float64, rounded and clipped."""
    noise = NOISE[id](c, p, maps) if id in NOISE else c
    step = SAMPLE.get(id, lambda rng, x, p, m, c: x)
    x = np.broadcast_to(c["mean"] / noise["gain"], (frames, *c["mean"].shape[1:])).copy()
    x = step(rng, x, p, maps, c) if acts_on == "mean" else x
    x = np.maximum(x, 0)
    share = noise.get("share", 1.0)
    x = x + share * (rng.poisson(x) - x) + np.sqrt((1 - share**2) * x) * rng.normal(size=x.shape)
    x = step(rng, x, p, maps, c) if acts_on == "charge" else x
    read = _tukey(rng, x.shape, noise["tail"]) if "tail" in noise else rng.normal(size=x.shape)
    x = c["black"] + noise["gain"] * (x + noise["read"] * read)
    x = step(rng, x, p, maps, c) if acts_on == "signal" else x
    q = noise["step"]
    x = np.clip(np.round(x / q) * q, 0, c["white"] // q * q)
    x = step(rng, x, p, maps, noise) if acts_on == "code" else x
    return np.clip(np.round(x / q) * q, 0, c["white"] // q * q)
