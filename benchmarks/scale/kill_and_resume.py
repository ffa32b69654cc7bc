"""A job killed at random moments and started again, until it is done; then compared, byte for byte, with a calm run.

    python -m benchmarks.scale.kill_and_resume out/killed --calm out/calm --kills 20 --seconds 30 \
        -- trace lobby --preset paper

What stands after `--` is an rf3dgs command without its --out. The calm folder is made first when it is not there. Each
run is killed with SIGKILL a random time below `--seconds` after it took the folder's lock, which is often before its
first shard, or, every second one, after a new shard appeared. The last run is left to finish. Prints a line of JSON;
the exit status is 1 when a byte differs or a run ended before it was killed.
"""

import argparse
import hashlib
import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path


def digest_of(folder: Path) -> dict[str, bytes]:
    return {item.name: hashlib.sha256(item.read_bytes()).digest() for item in sorted(folder.iterdir())}


def killed(command: list[str], out: Path, seconds: float, *, after_a_shard: bool) -> bool:
    """Start a run and kill it `seconds` after it began to work, or made a shard; False when it had ended before."""
    process = subprocess.Popen(command)
    while process.poll() is None and f'"pid": {process.pid},' not in text_of(out / "lock.json"):
        time.sleep(0.01)
    there = shards(out)
    while process.poll() is None and after_a_shard and shards(out) == there:
        time.sleep(0.01)
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL


def text_of(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


def shards(folder: Path) -> int:
    return sum(item.name[0].isdigit() for item in folder.iterdir()) if folder.exists() else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--calm", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("command", nargs="+")
    options = parser.parse_args()
    base = [sys.executable, "-m", "rf3dgs", *options.command]
    subprocess.run([*base, "--out", str(options.calm)], check=True)
    generator, command = random.Random(options.seed), [*base, "--out", str(options.out)]
    kills, began = 0, []
    for number in range(options.kills):
        kills += killed(command, options.out, generator.uniform(0.0, options.seconds), after_a_shard=number % 2 == 1)
        began.append(shards(options.out))
    subprocess.run(command, check=True)
    calm, after = digest_of(options.calm), digest_of(options.out)
    differing = sorted(name for name in calm.keys() | after.keys() if calm.get(name) != after.get(name))
    print(json.dumps({"kills": kills, "files": len(calm), "differing": differing, "after_each_kill": began}))
    return int(bool(differing) or kills < options.kills)


if __name__ == "__main__":
    sys.exit(main())
