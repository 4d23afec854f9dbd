"""The same with the published method, with progress, errors against the known transform, and pictures.

python examples/02_follow_and_look.py OUTPUT_FOLDER
"""

import json
import sys
from pathlib import Path

from regnf_core import OrientedBox, RegistrationOptions, Sim3, open_field, register
from regnf_core.document import result_document
from regnf_core.viewing.artifacts import write_artifacts

if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
    sys.exit(f"usage: {__doc__}")
data = Path(__file__).parent / "data"
output = Path(sys.argv[1])
output.mkdir(parents=True, exist_ok=True)
box = OrientedBox.from_dict(json.loads((data / "detection.json").read_text()))
truth = Sim3.from_dict(json.loads((data / "truth.json").read_text())["T_object_scene"])

result = register(
    open_field(data / "mix-room.safetensors"),
    open_field(data / "armchair.safetensors"),
    box,
    RegistrationOptions.from_dict({"preset": "paper", "optimization": {"iterations": 150}}),
    seed=3,
    progress=lambda phase, share: print(f"\r{phase:>14} {share:4.0%}", end="", file=sys.stderr),
)
print(file=sys.stderr)
print(json.dumps(result_document(result, truth=truth)["metrics"], indent=2))
print("wrote", ", ".join(write_artifacts(result, output, truth=truth)))
