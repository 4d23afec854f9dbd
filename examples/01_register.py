"""One call: where is the library's armchair in this room?

python examples/01_register.py
"""

import json
from pathlib import Path

from regnf_core import OrientedBox, open_field, register

data = Path(__file__).parent / "data"
box = json.loads((data / "detection.json").read_text())

result = register(
    open_field(data / "mix-room.safetensors"),
    open_field(data / "armchair.safetensors"),
    OrientedBox.from_quaternion(box["center"], box["size"], box["rotation_quaternion_xyzw"]),
)
print(result.verdict, result.verdict_reason)
print(result.T_object_scene.matrix())
