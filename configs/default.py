"""Cameras drawn from a prior, a small model, measured on five virtual cameras that it never saw: the whole
system in minutes on two CPU cores.

bin/train --workdir runs/first
"""

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder


def get_config() -> ConfigDict:
    """Every field, with the paper's value where it is another one."""
    return ConfigDict(
        {
            "seed": 0,
            # Folder of a run of the same networks whose weights training starts from, to fine-tune it on
            # --recordings; none: from scratch.
            "start": placeholder(str),
            "steps": 800,
            "batch_size": 16,  # paper: 64
            "patch": 32,  # packed pixels, what G and D are trained on; paper: 64
            "reference": 64,  # packed pixels, what E is trained on; paper: 64
            "width": 1 / 16,  # of every channel count; paper: 1
            # Of the convolutions in a training step: float32, or on an accelerator bfloat16. Weights, norms,
            # losses and the gradient penalty are float32 either way.
            "compute": "float32",
            "literal": False,  # the paper's tables and raw units as printed; see networks/
            "paper": False,  # the same without the two norms that keep it from learning any level
            "encoder": True,  # False: a generator without camera awareness
            # Fields of the modules.
            "networks": {
                "generator": {"hidden": 16, "physics": True, "residue": True},
                "encoder": {"latent_scale": 1.0},
                "critic": {"hidden": 16},
            },
            # poisson_gaussian (paper), gaussian, sensor:FILE (for all cameras), sensor:FILE,FILE (one each),
            # preset:NAME, or a function (key, clean, shot, read) -> (noise, sigma)
            "initial_noise": "poisson_gaussian",
            # Of the sensors of initial_noise, which then keep their own baseline too, and of the darks of
            # recordings; none: the level that is told, and darks of up to a second.
            "exposure_s": placeholder(float),
            # Where the initial noise's level comes from, in training as in use: estimated from the
            # references, given (paper), or both by turns, and G is told which.
            "level": "both",
            "clip": True,  # noise as clipped recordings show it, before the critic; paper: unsaid
            "critic_updates": 1,  # per generator update; paper: 1
            "critic_condition": "latent",  # what the critic is told: none (paper), camera, latent
            "camera_scale": 4.0,  # size of the camera's name beside the critic's features
            "ema": 0.995,  # of the weights of G and E; paper: none, 0
            "loss": {
                "adversarial": 0.0,  # paper: 1; 0 leaves the critic out
                "penalty": 10.0,
                "slope": 1.0,  # that the penalty asks for
                "feature_matching": 0.0,  # paper: 1
                "feature_target": "clean",  # in the noise slot of D: clean (paper) or real
                "statistics": 0.0,  # of the noise against the paired real noise; paper: none, 0
                # Of two draws against the paired real noise; paper: none, 0.
                "quantiles": 1.0,
                "spectra": 0.05,
                "knee": 0.0,  # of both, in sigma: what is larger counts by its logarithm; 0: as it is
                # Of the branches' parameters against those of a drawn camera; paper: none, 0.
                "physics": 1.0,
                "parts": {"level": 20.0, "tails": 1.0, "lines": 1.0, "neighbours": 1.0},
                "triplet": 0.5,
                "triplets": "batch",  # drawn: one for each patch (paper); batch: all that a batch forms
                "margin": 0.2,
            },
            "optimiser": {
                "generator_rate": 1.5e-3,  # paper: 2e-4
                "encoder_rate": 3e-3,  # paper: 2e-4, one optimiser for both
                "critic_rate": 2e-3,  # paper: 2e-4
                "beta1": 0.5,
                "beta2": 0.999,
                "schedule": "cosine",  # paper: constant
                "warmup": 100,  # steps; paper: 0
            },
            "compiler": {},  # XLA options of the training step
            "log_every": 50,
            "evaluate_every": 400,
            "validation_patches": 96,
            "references": 8,  # noisy patches that show the model its camera, when measured; paper: 1
            "checkpoint_every": 200,
            "data": {
                "source": "drawn",  # drawn, virtual, recordings (set by --recordings), sidd
                "seed": 0,
                "cameras": 512,  # drawn
                "references": 6,  # patches beside the target, of its setting: 1, 2, 3 or 6 of them are shown
                "validation_cameras": 24,
                "calibration_scenes": 40,  # of the virtual cameras, for the re-calibrated levels
                "scenes": 160,
                "validation_scenes": 10,
                "test_scenes": 20,
                "per_scene": 4,  # patches of one scene and camera in training
                "held_out_per_scene": 4,  # and in validation and test
                # For recordings: folders, one a camera, and what overrides their files.
                "recordings": (),
                "per_recording": 48,  # patches at most of one recording and split
                "half_real_scenes": 12,  # computed scenes on real darks, per camera and split
                "cfa": placeholder(str),
                "black_level": placeholder(tuple),
                "white_level": placeholder(float),
            },
        }
    )
