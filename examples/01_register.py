"""One call: find the pose of the library's armchair in this room.

python examples/01_register.py [SCENE OBJECT DETECTION]
"""

import json
import sys
from pathlib import Path

from regnf_core import OrientedBox, open_field, register

data = Path(__file__).parent / "data"
files = [Path(name) for name in sys.argv[1:]] or [
    data / name for name in ("mix-room.safetensors", "armchair.safetensors", "detection.json")
]
if len(files) != 3 or not all(file.is_file() for file in files):
    sys.exit(f"usage: {__doc__}")
scene, object_, detection = files

box = OrientedBox.from_dict(json.loads(detection.read_text()))
result = register(open_field(scene), open_field(object_), box)
print(result.verdict, result.verdict_reason)
print(result.T_scene_object.matrix())
