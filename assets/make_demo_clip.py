"""Cuts the demo clip out of a longer rendered clip: its first frames, images as WebP of high quality, exact flow of those frames.

    python assets/make_demo_clip.py CLIP assets/demo-clip --frames 5

Needs numpy and pillow. The layout of CLIP and of the result is one transforms/frame_XXXX.json per frame, with images/, masks/ and
flow/ per camera and points3D.ply.
"""
import argparse
import json
import shutil
from pathlib import Path

import numpy as np
from PIL import Image


def copy_image(source, target, **options):
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.open(source).save(target, **options)


def cut_transforms(clip, out, frames):
    cameras = set()
    for frame in range(1, frames + 1):
        name = f"transforms/frame_{frame:04}.json"
        document = json.loads((clip / name).read_text())
        for entry in document["frames"]:
            cameras.add(entry["camera"])
            entry["file_path"] = str(Path(entry["file_path"]).with_suffix(".webp"))
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(json.dumps(document, separators=(",", ":")) + "\n")
    return sorted(cameras)


def cut_flow(source, target, frames):
    arrays = np.load(source)
    target.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(target, flow_x64=arrays["flow_x64"][: frames - 1], visible=arrays["visible"][: frames - 1],
                        valid=arrays["valid"])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clip", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=5)
    arguments = parser.parse_args()
    clip, out, frames = arguments.clip, arguments.out, arguments.frames
    for camera in cut_transforms(clip, out, frames):
        for frame in range(1, frames + 1):
            name = f"{camera}/frame_{frame:04}"
            copy_image(clip / f"images/{name}.png", out / f"images/{name}.webp", quality=97, method=6)
            copy_image(clip / f"masks/{name}.png", out / f"masks/{name}.png", optimize=True)
        if not camera.startswith("test"):
            cut_flow(clip / f"flow/{camera}.npz", out / f"flow/{camera}.npz", frames)
    shutil.copyfile(clip / "points3D.ply", out / "points3D.ply")


if __name__ == "__main__":
    main()
