"""Every task with every robot, as a clip and with its rate of success from random starts.

python tools/gallery.py                  # all, into docs/images/gallery/; the table goes to stdout
python tools/gallery.py --only peg rebot # those whose names have all these words
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image, ImageSequence

import mjstack

ROOT = Path(__file__).parents[1]
LIMIT = 400_000  # bytes of a clip
ARMS = ("so101", "rebot")
# Name, folder of an example, and overrides
CLIPS = [
    *((f"{task}-{arm}", "", [f"task={task}", f"robot={arm}"]) for task in ("stack", "box", "reach")
      for arm in ARMS),
    *((f"{task}-{arm}", task, [f"task={task}", f"robot={arm}"])
      for task in ("slot", "peg", "push", "tower", "drawer") for arm in ARMS),
    ("stack-scara", "scara", ["robot=scara"]),
    *((f"{task}-panda", "panda", ["robot=panda", "model=menagerie", f"task={task}"])
      for task in ("stack", "box", "reach")),
]  # fmt: skip
NEAR = ("{pos: [0.42, 0.36, 0.36], target: [-0.1, 0.0, 0.06]}", 38.0)  # m; degrees
SIDE = ("{pos: [-0.05, -0.55, 0.4], target: [-0.02, 0.0, 0.05]}", 38.0)  # of what opens to the arm
FAR = ("{pos: [0.75, 0.7, 0.75], target: [-0.25, 0.0, 0.15]}", 38.0)  # of arms a metre long
LONG = ("panda", "scara")


def main() -> None:
    """Make the chosen clips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="words that a clip's name has")
    parser.add_argument("--folder", type=Path, default=ROOT / "docs/images/gallery")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    print("| clip | command | success, random starts | kB |\n| --- | --- | ---: | ---: |")
    for name, example, overrides in CLIPS:
        if not all(word in name.split("-") for word in args.only):
            continue
        config_dir = ROOT / "examples" / example / "conf" if example else None
        judge = ["gates=[success]", "sim=native", "nworld=64", "gate.success.seeds=2"]
        metrics = (
            mjstack.verify([*overrides, *judge], config_dir=config_dir).gates["success"].metrics
        )
        path = args.folder / f"{name}.webp"
        make_clip(path, [*(["--config-dir", str(config_dir)] if config_dir else []), *overrides])
        fit(path)
        size = path.stat().st_size
        folder = [f"--config-dir examples/{example}/conf"] if example else []
        command = " ".join(["mjstack", *folder, *overrides])
        rate = f"{metrics['succeeded']} of {metrics['episodes']}"
        print(f"| {name} | `{command}` | {rate} | {size // 1000} |", flush=True)


def fit(path: Path) -> None:
    """Leave out every second frame of a clip until it is small enough."""
    while path.stat().st_size > LIMIT:
        frames, times = [], []
        with Image.open(path) as clip:
            for frame in ImageSequence.Iterator(clip):
                frames.append(frame.convert("RGB"))
                times.append(clip.info["duration"])
        duration = [sum(times[number : number + 2]) for number in range(0, len(times), 2)]
        first, *rest = frames[::2]
        first.save(path, save_all=True, append_images=rest, duration=duration, loop=0, quality=60)


def make_clip(path: Path, args: list[str]) -> None:
    """Four worlds side by side, as a camera of the scene sees them."""
    pose, fovy = FAR if any(arm in path.stem for arm in LONG) else NEAR
    if "drawer" in path.stem:
        pose, fovy = SIDE
    with tempfile.TemporaryDirectory() as folder:
        camera = [f"scene.cameras.front.pose={pose}", f"scene.cameras.front.fovy={fovy}"]
        size = ["scene.cameras.front.size=[240,320]", "job.width=320", "job.fps=5"]
        show = ["experiment=clip", "job.format=webp", "nworld=4", "sim=native", "web.episode=false"]
        command = [sys.executable, "-m", "mjstack", *args, *show, *camera, *size]
        done = subprocess.run(
            [*command, f"hydra.run.dir={folder}/clip"], cwd=ROOT, capture_output=True, text=True
        )
        if done.returncode:
            raise SystemExit(f"{path.stem}: {done.stderr or done.stdout}")
        path.write_bytes((Path(folder) / "clip/episode.webp").read_bytes())


if __name__ == "__main__":
    main()
