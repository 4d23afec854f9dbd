import regnf

box = regnf.OrientedBox.from_center(center=[-0.56, -0.28, -0.24], size=[0.55, 0.61, 0.52])
found = regnf.search("examples/data/mix-room.safetensors", "examples/data", box, options={"up_axis": "z"})
for candidate in found.ranking:
    print(candidate.name, candidate.stage, candidate.score)
print(found.result.verdict, found.result.scale)
