"""Five virtual cameras from a key, a small model: the whole system in minutes on two CPU cores.

bin/train --workdir runs/first
"""

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder


def get_config() -> ConfigDict:
    """Every field, with the paper's value where it is another one."""
    return ConfigDict(
        {
            "seed": 0,
            "steps": 2000,
            "batch_size": 16,  # paper: 64
            "patch": 32,  # packed pixels, what G and D are trained on; paper: 64
            "reference": 64,  # packed pixels, what E is trained on; paper: 64
            "width": 1 / 16,  # of every channel count; paper: 1
            "literal": False,  # the paper's tables and raw units as printed; see networks/
            "encoder": True,  # False: a generator without camera awareness
            # Fields of the modules.
            "networks": {
                "generator": {"hidden": 16},
                "encoder": {},
                "critic": {"hidden": 16},
            },
            # poisson_gaussian (paper), gaussian, or a function (key, clean, shot, read) -> (noise, sigma)
            "initial_noise": "poisson_gaussian",
            # Where the initial noise's level comes from, in training as in use: estimated from the
            # references, given (paper), or both by turns, and G is told which.
            "level": "both",
            "clip": True,  # noise as clipped recordings show it, before the critic; paper: unsaid
            "critic_updates": 1,  # per generator update; paper: 1
            "critic_condition": "camera",  # what the critic is told: none (paper), camera, latent
            "camera_scale": 4.0,  # size of the camera's name beside the critic's features
            "ema": 0.999,  # of the weights of G and E; paper: none, 0
            "loss": {
                "adversarial": 1.0,
                "penalty": 10.0,
                "slope": 1.0,  # that the penalty asks for
                "feature_matching": 0.0,  # paper: 1
                "feature_target": "clean",  # in the noise slot of D: clean (paper) or real
                "statistics": 10.0,  # of the noise against the paired real noise; paper: none, 0
                "triplet": 0.5,
                "triplets": "batch",  # drawn: one for each patch (paper); batch: all that a batch forms
                "margin": 0.2,
            },
            "optimiser": {
                "generator_rate": 3e-4,  # paper: 2e-4
                "encoder_rate": 3e-3,  # paper: 2e-4, one optimiser for both
                "critic_rate": 2e-3,  # paper: 2e-4
                "beta1": 0.5,
                "beta2": 0.999,
                "schedule": "cosine",  # paper: constant
                "warmup": 100,  # steps; paper: 0
            },
            "compiler": {},  # XLA options of the training step
            "log_every": 50,
            "evaluate_every": 500,
            "validation_patches": 200,
            "references": 8,  # noisy patches that show the model its camera, when measured; paper: 1
            "checkpoint_every": 500,
            "data": {
                "source": "virtual",  # virtual, recordings (set by --recordings), sidd
                "seed": 0,
                "scenes": 384,
                "validation_scenes": 10,
                "test_scenes": 20,
                "per_scene": 4,  # patches of one scene and camera in training
                "held_out_per_scene": 16,  # and in validation and test
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
