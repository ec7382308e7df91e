"""``fgloc images`` and ``fgloc features evaluate`` as functions."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from factorgraph_loc.api.given import LogLike, Progress, RigLike, WorldLike, one
from factorgraph_loc.evaluation.features import scores as feature_scores
from factorgraph_loc.evaluation.features.feature_evaluation import feature
from factorgraph_loc.evaluation.features.sequences import find_sequences
from factorgraph_loc.experiments import image_localization

FEATURES = ("colour", "sift", "orb")


def images(
    log: LogLike,
    out: str | Path,
    *,
    mapped: Sequence[int],
    queries: Mapping[str, Sequence[int]],
    features: Sequence[str] = FEATURES,
    count: int = 1500,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
    overwrite: bool = False,
    progress: Callable[[float], None] = lambda _: None,
) -> image_localization.ImageResults:
    """Map some images of a log with their reference poses, localize the images of each query, and write the errors to ``out``."""
    image_localization.check_free(Path(out), overwrite=overwrite)
    loaded = one(log, rig, world)
    results = image_localization.evaluate_images(loaded, features, count, mapped, queries, progress)
    image_localization.write_results(loaded.name, results, Path(out))
    return results


def features(
    images: Sequence[str | Path],
    out: str | Path,
    *,
    features: Sequence[str] = FEATURES,
    count: int = 1000,
    overwrite: bool = False,
    progress: Progress = lambda _done, _total: None,
) -> feature_scores.FeatureScores:
    """Evaluate point features on images of planar scenes: folders of sequences, or photographs, which are warped."""
    feature_scores.check_free(Path(out), overwrite=overwrite)
    chosen = [feature(name, count) for name in features]
    scores = feature_scores.evaluate_all(find_sequences([Path(path) for path in images]), chosen, progress)
    feature_scores.write_scores(scores, Path(out))
    return scores
