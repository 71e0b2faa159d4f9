"""Declare: what the recordings are, and so which mechanisms they can show; for each of the others,
what to record."""

from __future__ import annotations

from cannoise_jax.discovery.locate import Located
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.signature import Signature
from cannoise_jax.vocabulary import VOCABULARY

NEEDS = {
    "gain_error": "run with --simulator nlf on files that state shot and read, with "
    "scenes or flats at two levels",
    "read_noise_error": "run with --simulator nlf on files that state shot and read, with "
    "darks of two frames or more",
    "prnu": "flats of two frames or more, or scenes with an independent reference",
    "dsnu": "darks of two frames or more",
    "column_gain": "flats of two frames or more, or scenes with an independent reference",
    "nonlinearity": "scenes with an independent reference that spans the range",
    "saturation": "scenes or flats of several levels, two frames or more each, up to the white level",
    "black_clipping": "darks",
    "crosstalk": "two frames or more of a lit scene or flat",
    "dark_current": "darks at two exposures or more, exposure_s stated",
    "amp_glow": "darks, best at a long exposure",
    "hot_pixels": "darks, best at a long exposure",
    "heavy_tails": "darks of two frames or more whose noise exceeds two thirds of a code",
    "pixel_read_noise_map": "three dark frames or more; eight are better",
    "rts": "three dark frames or more; a hundred show the two levels",
    "row_noise": "two frames or more at one setting",
    "column_noise": "two frames or more at one setting",
    "row_fpn": "darks of two frames or more",
    "column_fpn": "darks of two frames or more",
    "pink_noise": "two frames or more at one setting",
    "row_pink_noise": "two frames or more at one setting",
    "banding": "two frames or more at one setting",
    "offset_drift": "two recordings of two frames or more, best darks",
    "channel_offset": "darks, and a stated black level",
    "amplifier_mismatch": "darks of two frames or more",
    "green_imbalance": "flats, or scenes with an independent reference, from a Bayer sensor",
    "quantization": "files that state code_step",
    "missing_codes": "flats or scenes whose noise spans three codes or more",
    "in_camera_denoising": "two frames or more at one setting",
    "poisson_skew": "a simulator whose shot noise is Gaussian (that of the baseline is Poisson)",
    "excess_noise": "flats at five levels and the gain from another source, such as single-photon peaks",
    "clock_induced_charge": "several hundred short darks of an electron-multiplying sensor",
    "dual_gain": "flats and darks at five ISO values or more",
    "brighter_fatter": "two frames or more of bright flats",
    "lens_shading": "flats with a reference of the light falling on the sensor (clean)",
    "dead_pixels": "flats at two levels, with a hundred dead pixels or more in the frame",
    "cosmic_rays": "long darks, ten frames or more",
    "temperature_drift": "darks with the temperature of every frame stated",
    "image_lag": "a burst with a change from bright to dark",
    "smear": "a scene with a saturated light source, two frames or more",
    "lossy_compression": "flats at ten levels up to the white level",
    "defect_correction": "twenty frames or more of one flat",
    "hot_pixel_suppression": "twenty long darks",
    "demosaicing": "two frames or more at one setting",
    "flicker": "two frames or more of a lit scene or flat",
    "illumination_drift": "two frames or more of a lit scene or flat, and of a second recording",
    "reference_error": "scenes with an independent reference",
    "misregistration": "scenes with an independent reference",
    "scene_motion": "ten frames or more of a scene with an independent reference",
    "bookkeeping": "darks, and a stated black level",
}


UNTESTED = (
    "poisson_skew",
    "excess_noise",
    "clock_induced_charge",
    "dual_gain",
    "dead_pixels",
    "cosmic_rays",
    "temperature_drift",
    "image_lag",
    "smear",
    "lossy_compression",
    "defect_correction",
    "hot_pixel_suppression",
    "scene_motion",
)
"""Ids that no statistic looks for, whatever is recorded."""


def registered(without: tuple[str, ...] = (), mechanisms: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """Ids that this run may name. Raises ValueError for an id that the vocabulary does not have."""
    known = [id for id in VOCABULARY if id != "unknown"]
    for id in (*without, *(mechanisms or ())):
        if id not in known:
            raise ValueError(f"{id}: no such mechanism; known: {', '.join(known)}")
    return tuple(id for id in known if id not in without and (mechanisms is None or id in mechanisms))


def testable(
    located: Located, signatures: tuple[Signature, ...], ids: tuple[str, ...]
) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Ids that some signature could test on these recordings, and the others with what to record."""
    tested = {p.mechanism for p in signatures if p.name in located.scores}
    yes = tuple(id for id in ids if id in tested)
    return yes, tuple((id, needs(id)) for id in ids if id not in tested)


def needs(id: str) -> str:
    """What to record for a mechanism; said so where no recording helps yet."""
    return f"nothing looks for it yet; it would show in {NEEDS[id]}" if id in UNTESTED else NEEDS[id]


def kinds(capture: CaptureSet) -> list[dict]:
    """One line per recording: what it is, as the report lists it."""
    out = []
    for r in capture.recordings:
        settings = {
            "iso": r.iso,
            "exposure_s": r.exposure_s,
            "temperature_c": r.temperature_c,
            "reference": r.reference if r.clean is not None else None,
        }
        out.append({"file": r.path or "in memory", "kind": r.kind, "frames": r.count, "settings": settings})
    return out
