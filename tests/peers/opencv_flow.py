#!/usr/bin/env python3
"""Tracks by OpenCV's flow methods beside ours, on clips with exact flow; and the time of DIS per pair of frames.

    pip install opencv-python-headless numpy
    tests/peers/opencv_flow.py CLIP... --program target/release/trackersplat [--quality balanced] > table.md
    tests/peers/opencv_flow.py --speed CLIP
    tests/peers/opencv_flow.py --enlarge 4 --views cam00,cam03,cam06 CLIP...

Not part of CI. Everything runs on one thread. Ours comes from `trackersplat eval-tracks CLIP --json`, on the same
views and frames and by the same definitions:

* Errors are those of all key-frame pixels that are truly visible at the frame (`visible` and `valid` of flow/*.npz),
  whatever the method says of them; "moving" are those inside the key frame's mask.
* "direct" is the flow from the key frame to the frame; "chained" adds the flows of successive frames, read bilinearly
  at the place reached.
* OpenCV's methods get grey images, which is all that they take. Ours matches in colour; its row "on luma" is measured
  with `--set tracking.colour=false`, and sees what they see.
* Lucas-Kanade (pyramidal, window 21, four levels) is asked for every fourth pixel of every fourth row, and
  interpolated between them: asked for every pixel it takes a second per pair. Points that it reports as lost have no
  position: they move as the nearest found point of the same grid does; if none is found, all rest.
* Flow methods say nothing of visibility, which the average Jaccard needs: visible is what stays inside the image and
  agrees with the flow back, |f+b|^2 < 0.01 (|f|^2+|b|^2) + 0.5 (Sundaram et al., 2010), in every step of a chain.
* Points: bilinear between pixel centres, visibility of the nearest pixel, TAP-Vid's thresholds at 256x256, mean over
  views.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import time

import cv2
import numpy as np

THRESHOLDS = [1, 2, 4, 8, 16]


def dis(preset):
    solver = cv2.DISOpticalFlow_create(preset)
    return lambda a, b: solver.calc(a, b, None)


def farneback(a, b):
    return cv2.calcOpticalFlowFarneback(a, b, None, 0.5, 5, 15, 3, 5, 1.2, 0)


def lucas_kanade(a, b, step=4):
    height, width = a.shape
    points = grid(width, height)[step // 2 :: step, step // 2 :: step]
    asked = points.reshape(-1, 1, 2).astype(np.float32)
    found, status, _ = cv2.calcOpticalFlowPyrLK(a, b, asked, None, winSize=(21, 21), maxLevel=3)
    sparse = (found - asked).reshape(points.shape)
    sparse = of_nearest_found(sparse.astype(float), status.reshape(points.shape[:2]) == 1)
    return fetch(sparse, (grid(width, height) - step // 2) / step)


def of_nearest_found(field, found):
    """`field` [H, W, 2] with the value of the nearest found entry where `found` [H, W] is false; 0 if none is found."""
    if not found.any():
        return np.zeros_like(field)
    taken, lost = np.argwhere(found), np.argwhere(~found)
    filled = field.copy()
    for y, x in lost:
        near = taken[((taken - (y, x)) ** 2).sum(-1).argmin()]
        filled[y, x] = field[tuple(near)]
    return filled


METHODS = {
    "OpenCV DIS fast": dis(cv2.DISOPTICAL_FLOW_PRESET_FAST),
    "OpenCV DIS medium": dis(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM),
    "OpenCV Farneback": farneback,
    "OpenCV Lucas-Kanade": lucas_kanade,
}


def grid(width, height):
    """Pixel indices x, y; OpenCV's flow lives on them."""
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64)


def fetch(field, at):
    """`field` [H, W, K] at indices `at` [..., 2], bilinear, clamped to the image."""
    height, width = field.shape[:2]
    x, y = np.clip(at[..., 0], 0, width - 1), np.clip(at[..., 1], 0, height - 1)
    x0, y0 = x.astype(int), y.astype(int)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    above = field[y0, x0] * (1 - fx) + field[y0, x1] * fx
    below = field[y1, x0] * (1 - fx) + field[y1, x1] * fx
    return above * (1 - fy) + below * fy


def inside(at, width, height):
    return (at[..., 0] >= -0.5) & (at[..., 1] >= -0.5) & (at[..., 0] <= width - 0.5) & (at[..., 1] <= height - 0.5)


def consistent(forward, backward):
    height, width = forward.shape[:2]
    there = grid(width, height) + forward
    back = fetch(backward, there)
    error = ((forward + back) ** 2).sum(-1)
    return inside(there, width, height) & (error < 0.01 * ((forward**2).sum(-1) + (back**2).sum(-1)) + 0.5)


def tracks(method, images):
    """Displacements and visibility to every later frame: (direct, chained)."""
    direct, chained = [], []
    height, width = images[0].shape
    at, seen = grid(width, height), np.ones((height, width), bool)
    for earlier, frame in zip(images, images[1:]):
        forward, backward = method(images[0], frame), method(frame, images[0])
        direct.append((forward.astype(float), consistent(forward, backward)))
        step, back = method(earlier, frame), method(frame, earlier)
        holds = consistent(step, back).astype(float)[..., None]
        seen = seen & (fetch(holds, at)[..., 0] > 0.5)
        at = at + fetch(step.astype(float), at)
        seen = seen & inside(at, width, height)
        chained.append((at - grid(width, height), seen))
    return {"direct": direct, "chained": chained}


class Clip:
    def __init__(self, folder, views):
        self.folder = pathlib.Path(folder)
        self.cameras = {c["name"]: c for c in json.loads((self.folder / "cameras.json").read_text())["cameras"]}
        self.views = views or [n for n, c in self.cameras.items() if c["split"] == "train"]
        points = np.load(self.folder / "tracks.npz")
        self.points = {key: points[key] for key in points}

    def images(self, view):
        files = sorted((self.folder / "images" / view).glob("frame_*.png"))
        return [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]

    def truth(self, view):
        stored = np.load(self.folder / "flow" / f"{view}.npz")
        flow = stored["flow_x64"] / 64.0
        frames, height, width, _ = flow.shape
        pixels = height * width
        valid = np.unpackbits(stored["valid"])[:pixels].reshape(height, width).astype(bool)
        visible = np.unpackbits(stored["visible"].reshape(frames, -1), axis=-1)[:, :pixels]
        mask = cv2.imread(str(self.folder / "masks" / view / "frame_0001.png"), cv2.IMREAD_UNCHANGED) > 0
        return flow, visible.reshape(frames, height, width).astype(bool) & valid, mask

    def point_tracks(self, view):
        """Pixel positions [T, N, 2] and visibility [T, N] of the points that the view sees at the key frame."""
        camera, data = self.cameras[view], self.points
        column = list(data["cameras"]).index(view)
        visible = np.unpackbits(data["visible"][:, column], axis=-1)[:, : int(data["n"])].astype(bool)
        world_to_camera = np.array(camera["w2c_opencv"])
        local = data["xyz"] @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        pixel = local[..., :2] / local[..., 2:] * [camera["fx"], camera["fy"]] + [camera["cx"], camera["cy"]]
        height, width = self.images(view)[0].shape
        start = pixel[0]
        asked = visible[0] & (start >= 0).all(-1) & (start[:, 0] < width) & (start[:, 1] < height)
        return pixel[:, asked], visible[:, asked]


class Scores:
    def __init__(self):
        self.errors, self.moving, self.delta, self.jaccard = [], [], [], []

    def view(self, clip, view, fields):
        flow, visible, mask = clip.truth(view)
        for (displacement, _), exact, seen in zip(fields, flow, visible):
            error = np.linalg.norm(displacement - exact, axis=-1)
            self.errors.append(error[seen])
            self.moving.append(error[seen & mask])
        self.points(clip, view, fields)

    def points(self, clip, view, fields):
        pixel, visible = clip.point_tracks(view)
        start = pixel[0]
        height, width = fields[0][0].shape[:2]
        nearest = start.astype(int)
        distance, called = [], []
        for (displacement, seen), exact in zip(fields, pixel[1:]):
            at = start + fetch(displacement, start - 0.5)
            distance.append(np.linalg.norm((at - exact) * [256 / width, 256 / height], axis=-1))
            called.append(seen[nearest[:, 1], nearest[:, 0]])
        distance, called, visible = np.array(distance), np.array(called), visible[1:]
        delta, jaccard = [], []
        for threshold in THRESHOLDS:
            found = visible & (distance < threshold)
            right = (found & called).sum()
            delta.append(found.sum() / visible.sum())
            jaccard.append(right / (visible.sum() + called.sum() - right))
        self.delta.append(np.mean(delta))
        self.jaccard.append(np.mean(jaccard))

    def row(self):
        def figures(errors):
            errors = np.concatenate(errors)
            if not len(errors):
                return None
            return {"mean": errors.mean(), "median": np.median(errors), "p90": np.quantile(errors, 0.9)}

        return {
            "all": figures(self.errors),
            "moving": figures(self.moving),
            "delta": np.mean(self.delta),
            "jaccard": np.mean(self.jaccard),
        }


def ours(program, clip, views, quality, colour):
    command = [program, "eval-tracks", str(clip), "--json", "--quality", quality]
    command += ["--set", f"tracking.colour={'true' if colour else 'false'}"]
    if views:
        command += ["--views", ",".join(views)]
    report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    points = report["points"]["all"]
    return {
        "all": report["pixels"]["all"]["endpoint"],
        "moving": report["pixels"]["moving"]["endpoint"],
        "delta": points["delta_average"],
        "jaccard": points["average_jaccard"],
    }


def print_table(name, rows):
    print(f"\n### {name}\n")
    print("| method | EPE all: mean | median | 90 % | EPE moving: mean | median | 90 % | δ_avg | AJ |")
    print("|---|---|---|---|---|---|---|---|---|")
    for method, row in rows:
        cells = []
        for group in (row["all"], row["moving"]):
            cells += [f"{group[key]:.3f}" if group else "–" for key in ("mean", "median", "p90")]
        print(f"| {method} | " + " | ".join(cells) + f" | {100 * row['delta']:.1f} | {100 * row['jaccard']:.1f} |")
    sys.stdout.flush()


def accuracy(folder, arguments):
    views = arguments.views.split(",") if arguments.views else []
    clip = Clip(folder, views)
    rows = []
    for name, method in METHODS.items():
        scores = {"direct": Scores(), "chained": Scores()}
        for view in clip.views:
            for kind, fields in tracks(method, clip.images(view)).items():
                scores[kind].view(clip, view, fields)
        rows += [(f"{name}, {kind}", score.row()) for kind, score in scores.items()]
    if arguments.program:
        for quality in arguments.quality.split(","):
            for name, colour in [(quality, True), (f"{quality}, on luma", False)]:
                rows.append((f"**ours, {name}**", ours(arguments.program, folder, views, quality, colour)))
    print_table(clip.folder.name, rows)


def enlarged(folder, views, factor):
    """Errors of DIS, direct, on frames enlarged by a factor (bicubic), in pixels of the clip: the flow is averaged over what
    each pixel became. Ours is `cargo bench -p splat --bench pair_flow -- --enlarge FACTOR`."""
    clip = Clip(folder, views)
    for name, preset in {"fast": 1, "medium": 2}.items():
        method, errors, moving = dis(preset), [], []
        for view in clip.views:
            images = clip.images(view)
            height, width = images[0].shape
            size = (factor * width, factor * height)
            images = [cv2.resize(image, size, interpolation=cv2.INTER_CUBIC) for image in images]
            flow, visible, mask = clip.truth(view)
            for image, exact, seen in zip(images[1:], flow, visible):
                found = method(images[0], image).reshape(height, factor, width, factor, 2).mean((1, 3)) / factor
                error = np.linalg.norm(found - exact, axis=-1)
                errors.append(error[seen])
                moving.append(error[seen & mask])
        groups = [np.concatenate(group) for group in (errors, moving)]
        cells = [f"{group.mean():.3f} / {np.median(group):.3f}" if len(group) else "–" for group in groups]
        print(f"| DIS {name}, {factor} times | {clip.folder.name} | " + " | ".join(cells) + " |")


def speed(folder, repeats=15):
    """Milliseconds of processor time per pair of frames, the least of several; ours is `cargo bench -p splat --bench pair_flow`."""
    view = sorted((pathlib.Path(folder) / "images").iterdir())[0]
    pair = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in sorted(view.glob("frame_*.png"))[:2]]
    presets = {"ultrafast": 0, "fast": 1, "medium": 2}
    print("\n| OpenCV DIS | 640x360 ms | 1280x720 ms |\n|---|---|---|")
    for name, preset in presets.items():
        method, cells = dis(preset), []
        for size in [(640, 360), (1280, 720)]:
            a, b = (cv2.resize(image, size, interpolation=cv2.INTER_CUBIC) for image in pair)
            least = float("inf")
            for _ in range(repeats):
                start = time.thread_time()
                method(a, b)
                least = min(least, time.thread_time() - start)
            cells.append(f"{1e3 * least:.1f}")
        print(f"| {name} | {cells[0]} | {cells[1]} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+")
    parser.add_argument("--program", help="trackersplat, to measure beside")
    parser.add_argument("--quality", default="balanced", help="presets of ours, separated by commas")
    parser.add_argument("--views", help="names, separated by commas; all training views if left out")
    parser.add_argument("--speed", action="store_true", help="the time of DIS per pair instead")
    parser.add_argument("--enlarge", type=int, help="DIS on frames enlarged by this factor instead: mean / median, all and moving")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for folder in arguments.clips:
        if arguments.speed:
            speed(folder)
        elif arguments.enlarge:
            enlarged(folder, arguments.views.split(",") if arguments.views else [], arguments.enlarge)
        else:
            accuracy(folder, arguments)


if __name__ == "__main__":
    main()
