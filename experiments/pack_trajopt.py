"""Put finished searches into one archive, or take them out of it again.

`result.json` and `trajectory.json` of every subfolder of --out go into `searches.npz` there, to the last bit; the
subfolders may be removed then. `benchmark_trajopt.py --report` and `replay_trajopt.py` read the archive as they read
subfolders. With --unpack, subfolders are written from it, for `torchdlo play --trajectory`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from options import Parser

EXAMPLES = """examples:
  python experiments/pack_trajopt.py --out runs/trajopt
  python experiments/pack_trajopt.py --out experiments/trajopt --unpack runs/unpacked
"""


def main() -> None:
    """Pack or unpack."""
    from torchdlo.agents.trajopt.stored import NAME, pack_searches, unpack_searches

    parser = Parser("pack_trajopt.py", description=__doc__, epilog=EXAMPLES)
    parser.add_argument("--out", default="runs/trajopt", help="folder of the searches; default: %(default)s")
    parser.add_argument("--unpack", default="", help="folder for subfolders of what is in the archive of --out")
    args = parser.parse_args()
    archive = Path(args.out) / NAME
    if args.unpack:
        unpack_searches(archive, args.unpack)
        return
    if not list(Path(args.out).glob("*/result.json")):
        sys.exit(f"error: {args.out}: expected subfolders of finished searches, found none.")
    print(f"{archive}: {pack_searches(args.out, archive)} searches")


if __name__ == "__main__":
    main()
