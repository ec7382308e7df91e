"""Benchmark of point features of images: the sections of docs/features.md."""

from __future__ import annotations

import time

import cv2
import numpy as np
from benchmarking.report import Options, Report

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.features.feature_evaluation import Feature
from factorgraph_loc.evaluation.features.repeatability import distinct
from factorgraph_loc.evaluation.features.scores import evaluate_all, summary, write_scores
from factorgraph_loc.evaluation.features.sequences import Sequence, find_sequences
from factorgraph_loc.files.data_root import find_data_root
from factorgraph_loc.vision.colour_features import ColourExtractor
from factorgraph_loc.vision.features import EXTRACTORS, Keypoints, extractor

SEQUENCES = ("bark", "boat", "graf")
COUNT = 1000
STANDARD = "sift"
SPEED_SIZE, SPEED_COUNT, ROUNDS = (640, 480), 500, 15


def oxford(options: Options) -> list[Sequence]:
    """Return the image sequences of the Oxford data set."""
    root = find_data_root(options.data_root, "features")
    return find_sequences([root / "oxford_affine" / name for name in SEQUENCES])


def sequences_section(options: Options) -> Report:
    """Evaluate all features on image sequences. Random points with the sizes of SIFT's points show the scores of chance."""
    report, sequences = Report("sequences", options), oxford(options)
    others = [
        Feature("colour, of grey images", of_grey()),
        Feature("colour, literal neighbours", ColourExtractor(COUNT, paper_literal=True).detectAndCompute),
        Feature("sift, each once", each_once()),
        Feature("chance", chance()),
    ]
    features = [*(Feature(name, extractor(name, COUNT).detectAndCompute) for name in EXTRACTORS), *others]
    scores = evaluate_all(sequences, features, report.tell)
    write_scores(scores, options.out / "sequences")
    report.say(f"The scores are means over {sum(len(sequence.others) for sequence in sequences)} pairs of images.")
    report.table(*summary(scores))
    return report


def of_grey():
    """Return a detector of colour features that uses grey images."""
    features = ColourExtractor(COUNT)

    def find(image):
        return features.detectAndCompute(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))

    return find


def each_once():
    """Return a detector of SIFT's points. A point with several orientations is returned once."""
    every = extractor(STANDARD, 10 * COUNT)
    return lambda image: (distinct(every.detect(image))[:COUNT], None)


def chance():
    """Return a detector of random points. Their number and sizes are those of SIFT's points in the same image."""
    rng = np.random.default_rng(0)
    standard = extractor(STANDARD, COUNT)

    def find(image):
        found = standard.detect(image)
        points = rng.uniform((0.0, 0.0), (image.shape[1] - 1.0, image.shape[0] - 1.0), (len(found), 2))
        sizes = rng.permutation(found.sizes)
        return Keypoints(points, sizes, found.angles, found.responses), None

    return find


def speed_section(options: Options) -> Report:
    """Measure the computing time of each feature. Features take turns many times, so that other load affects all of them
    equally."""
    report = Report("speed", options)
    cv2.setNumThreads(1)
    (scene,) = (sequence.first for sequence in oxford(options) if sequence.name == "graf")
    width, height = SPEED_SIZE
    if scene.shape[0] < height or scene.shape[1] < width:
        raise InputError(f"graf: has {scene.shape[1]} x {scene.shape[0]} px, expected at least {width} x {height}")
    image = np.ascontiguousarray(scene[:height, :width])
    features = {name: extractor(name, SPEED_COUNT) for name in EXTRACTORS}
    times = {name: [] for name in features}
    found = {}
    for _ in range(ROUNDS + 1):
        for name, one in features.items():
            started = time.perf_counter()
            found[name] = len(one.detectAndCompute(image)[0])
            times[name].append(1e3 * (time.perf_counter() - started))
    # the first round compiles and fills caches
    times = {name: np.array(taken[1:]) for name, taken in times.items()}
    rows = []
    for name, taken in times.items():
        ratio = taken / times[STANDARD]
        cells = (f"{np.median(taken):.1f}", f"{taken.min():.1f}", f"{np.median(ratio):.2f}")
        rows.append([name, str(found[name]), *cells])
    head = ("feature", "points", "median [ms]", "least [ms]", f"median ratio to {STANDARD}")
    report.say(f"Colour images of {width} x {height} px, {SPEED_COUNT} points, one thread, {ROUNDS} repetitions.")
    report.table(head, rows)
    return report


SECTIONS = {"sequences": sequences_section, "speed": speed_section}
