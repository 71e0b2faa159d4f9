"""Listed mechanisms in other forms than the package's own: what a search should call by their names."""

from __future__ import annotations

import numpy as np

from cannoise_jax.blind.plain_camera import Camera, Effect, Make, Shot

Rng = np.random.Generator


def nothing(rng: Rng, camera: Camera) -> Effect:
    """No effect."""
    return Effect()


def vignette(rng: Rng, camera: Camera) -> Effect:
    """Flats whose corners are 15 to 50 % darker: no effect of the sensor."""
    y, x = (np.linspace(-0.5, 0.5, n) for n in camera.size)
    light = np.cos(np.arctan(np.hypot(y[:, None], x) * rng.uniform(0.8, 1.6))) ** 4
    return Effect(light=lambda e, shot, rng: e * light if shot.kind == "flat" else e)


def rows(rng: Rng, camera: Camera) -> Effect:
    """White row noise."""
    sigma = camera.read_dn * rng.uniform(0.2, 0.5)
    return Effect(analog=lambda v, shot, rng: v + sigma * rng.normal(size=(len(v), 1)))


def slow_rows(rng: Rng, camera: Camera) -> Effect:
    """Row noise of a power law of exponent 0.7 to 1.3."""
    sigma, exponent = camera.read_dn * rng.uniform(0.25, 0.5), rng.uniform(0.7, 1.3)

    def analog(v, shot: Shot, rng: Rng):
        return v + sigma * _power_law(rng, 4 * len(v), exponent)[: len(v), None]

    return Effect(analog=analog)


def slow_raster(rng: Rng, camera: Camera) -> Effect:
    """1/f noise along the raster."""
    sigma = camera.read_dn * rng.uniform(0.4, 0.8)
    return Effect(analog=lambda v, shot, rng: v + sigma * _power_law(rng, v.size, 1.0).reshape(v.shape))


def _power_law(rng: Rng, number: int, exponent: float) -> np.ndarray:
    frequency = np.fft.rfftfreq(number)
    spectrum = rng.normal(size=frequency.size) + 1j * rng.normal(size=frequency.size)
    spectrum[0], spectrum[1:] = 0, spectrum[1:] * frequency[1:] ** (-exponent / 2)
    noise = np.fft.irfft(spectrum, number)
    return noise / noise.std()


def responses(rng: Rng, camera: Camera) -> Effect:
    """Pixels of different response."""
    gains = 1 + rng.uniform(0.005, 0.02) * rng.normal(size=camera.size)
    return Effect(light=lambda e, shot, rng: e * gains)


def offsets(rng: Rng, camera: Camera) -> Effect:
    """Pixels of different offset."""
    field = camera.read_dn * rng.uniform(0.3, 0.8) * rng.normal(size=camera.size)
    return Effect(analog=lambda v, shot, rng: v + field)


def columns(rng: Rng, camera: Camera) -> Effect:
    """Columns of different offset."""
    field = camera.read_dn * rng.uniform(0.1, 0.3) * rng.normal(size=camera.size[1])
    return Effect(analog=lambda v, shot, rng: v + field)


def uneven_rows(rng: Rng, camera: Camera) -> Effect:
    """Even rows are offset."""
    step = camera.read_dn * rng.uniform(0.1, 0.3)
    return Effect(analog=lambda v, shot, rng: v + step * (1 - np.arange(len(v)) % 2)[:, None])


def hot(rng: Rng, camera: Camera) -> Effect:
    """A few pixels of much dark current."""
    sites = _sites(rng, camera, 0.002, 0.01)
    rate = rng.exponential(40 * camera.read_e, sites.size)

    def charge(q, shot: Shot, rng: Rng):
        out = q.copy().ravel()
        out[sites] += rng.poisson(rate * shot.seconds)
        return out.reshape(q.shape)

    return Effect(charge=charge)


def _sites(rng: Rng, camera: Camera, least: float, most: float) -> np.ndarray:
    pixels = camera.size[0] * camera.size[1]
    return rng.choice(pixels, int(rng.uniform(least, most) * pixels), replace=False)


def telegraph(rng: Rng, camera: Camera) -> Effect:
    """A few pixels of two levels, whose shares differ."""
    sites = _sites(rng, camera, 0.002, 0.01)
    step = camera.read_dn * rng.uniform(3, 9, sites.size)
    share = rng.uniform(0.2, 0.8, sites.size)

    def analog(v, shot: Shot, rng: Rng):
        out = v.copy().ravel()
        out[sites] += step * (rng.random(sites.size) < share)
        return out.reshape(v.shape)

    return Effect(analog=analog)


def dead(rng: Rng, camera: Camera) -> Effect:
    """A few pixels that see a twentieth of the light."""
    sites = _sites(rng, camera, 0.001, 0.005)
    response = np.ones(camera.size[0] * camera.size[1])
    response[sites] = 0.05
    return Effect(light=lambda e, shot, rng: e * response.reshape(e.shape))


def dark_current(rng: Rng, camera: Camera) -> Effect:
    """Charge that grows with the exposure."""
    rate = camera.read_e**2 * rng.uniform(1, 6)
    return Effect(charge=lambda q, shot, rng: q + rng.poisson(rate * shot.seconds, q.shape))


def corner_glow(rng: Rng, camera: Camera) -> Effect:
    """Charge that falls off from a corner."""
    y, x = np.indices(camera.size)
    away = np.hypot(y - rng.choice([0, camera.size[0]]), x - rng.choice([0, camera.size[1]]))
    rate = np.exp(-away / rng.uniform(20, 50)) * camera.read_e**2 * rng.uniform(4, 15)
    return Effect(charge=lambda q, shot, rng: q + rng.poisson(rate * shot.seconds))


def tracks(rng: Rng, camera: Camera) -> Effect:
    """Tracks of particles, of exponential length and charge."""
    rate = rng.uniform(5, 30)

    def charge(q, shot: Shot, rng: Rng):
        out = q.copy()
        for _ in range(rng.poisson(rate * shot.seconds)):
            start, angle = rng.uniform(0, q.shape), rng.uniform(0, 2 * np.pi)
            steps = np.arange(0, rng.exponential(4) + 1, 0.5)[:, None]
            path = np.floor(start + steps * [np.sin(angle), np.cos(angle)]).astype(int)
            for at in path[((path >= 0) & (path < q.shape)).all(1)]:
                out[tuple(at)] += rng.exponential(30 * camera.read_e)
        return out

    return Effect(charge=charge)


def lag(rng: Rng, camera: Camera) -> Effect:
    """Each frame holds a little of the one before."""
    share = rng.uniform(0.02, 0.06)

    def charge(q, shot: Shot, rng: Rng):
        last = shot.state.get("last", q)
        shot.state["last"] = q
        return (1 - share) * q + share * last

    return Effect(charge=charge)


def late_charge(rng: Rng, camera: Camera) -> Effect:
    """Hot pixels, and charge that rows leave behind for those below or above, in a few steps."""
    hot_ones, share, stays = hot(rng, camera), rng.uniform(0.03, 0.1), rng.uniform(0.2, 0.7)
    up = rng.random() < 0.5

    def charge(q, shot: Shot, rng: Rng):
        q = hot_ones.charge(q, shot, rng)
        lines, held = q[::-1] if up else q, np.zeros(q.shape[1])
        out = np.empty(lines.shape)
        for i, line in enumerate(lines):
            out[i] = (1 - share) * line + (1 - stays) * held
            held = stays * held + share * line
        return out[::-1] if up else out

    return Effect(charge=charge)


def bent(rng: Rng, camera: Camera) -> Effect:
    """A response that bends, for the noise as for the light."""
    bend = rng.uniform(0.02, 0.06)
    return Effect(analog=lambda v, shot, rng: v * (1 - bend * v / camera.span))


def sinusoid(rng: Rng, camera: Camera) -> Effect:
    """A wave along the rows of random phase."""
    height, frequency = camera.read_dn * rng.uniform(0.3, 0.6), rng.uniform(0.03, 0.3)
    phase = 2 * np.pi * frequency * np.arange(camera.size[0])
    return Effect(analog=lambda v, shot, rng: v + height * np.sin(phase + rng.uniform(0, 2 * np.pi))[:, None])


def tails(rng: Rng, camera: Camera) -> Effect:
    """Read noise of Student's t, 3.5 to 6 degrees of freedom."""
    freedom = rng.uniform(3.5, 6)
    scale = camera.read_e * np.sqrt((freedom - 2) / freedom)
    return Effect(read=lambda z, shot, rng: scale * rng.standard_t(freedom, size=z.shape))


def loud_pixels(rng: Rng, camera: Camera) -> Effect:
    """Read noise that differs from pixel to pixel, log-normal."""
    factor = np.exp(rng.uniform(0.2, 0.4) * rng.normal(size=camera.size))
    return Effect(read=lambda z, shot, rng: z * factor)


def loud_columns(rng: Rng, camera: Camera) -> Effect:
    """Columns of unlike read noise, few of them much louder."""
    factor = 1 + rng.uniform(0.1, 0.3) * (rng.exponential(size=(1, camera.size[1])) - 1)
    return Effect(read=lambda z, shot, rng: z * factor)


def loud_rows(rng: Rng, camera: Camera) -> Effect:
    """Rows that converters take in turns, each of its own read noise."""
    turns = rng.uniform(1 - rng.uniform(0.1, 0.3), 1, int(rng.integers(3, 9)))
    factor = turns[np.arange(camera.size[0]) % turns.size][:, None]
    return Effect(read=lambda z, shot, rng: z * factor)


def jumping_offset(rng: Rng, camera: Camera) -> Effect:
    """The black level of each frame is its own."""
    sigma = camera.read_dn * rng.uniform(0.2, 0.6)
    return Effect(analog=lambda v, shot, rng: v + sigma * rng.normal())


LISTED: dict[str, tuple[Make, tuple[str, ...]]] = {
    "rows": (rows, ("row_noise",)),
    "slow_rows": (slow_rows, ("row_pink_noise",)),
    "slow_raster": (slow_raster, ("pink_noise",)),
    "responses": (responses, ("prnu",)),
    "offsets": (offsets, ("dsnu",)),
    "columns": (columns, ("column_fpn",)),
    "uneven_rows": (uneven_rows, ("channel_offset",)),
    "hot": (hot, ("hot_pixels",)),
    "telegraph": (telegraph, ("rts",)),
    "dead": (dead, ("dead_pixels",)),
    "dark_current": (dark_current, ("dark_current",)),
    "corner_glow": (corner_glow, ("amp_glow",)),
    "tracks": (tracks, ("cosmic_rays",)),
    "lag": (lag, ("image_lag",)),
    "late_charge": (late_charge, ("parallel_cti",)),
    "bent": (bent, ("nonlinearity",)),
    "sinusoid": (sinusoid, ("banding",)),
    "tails": (tails, ("heavy_tails",)),
    "loud_pixels": (loud_pixels, ("pixel_read_noise_map",)),
    "loud_columns": (loud_columns, ("column_read_noise_map",)),
    "loud_rows": (loud_rows, ("row_read_noise_map",)),
    "jumping_offset": (jumping_offset, ("offset_drift",)),
}
"""Effects and the name that each should get."""
NULLS: dict[str, Make] = {"nothing": nothing, "vignette": vignette}
