import regnf

corners = [([-0.84, -0.59, -0.50], [-0.29, 0.02, 0.02]), ([0.30, 0.30, -0.50], [0.80, 0.80, 0.00])]
boxes = [regnf.OrientedBox.from_corners(low, high) for low, high in corners]
room, chair = "examples/data/mix-room.safetensors", "examples/data/armchair.safetensors"
for outcome in regnf.register_batch(room, boxes, [chair], options={"up_axis": "z"}):
    print(outcome.detection, outcome.result or outcome.error)
