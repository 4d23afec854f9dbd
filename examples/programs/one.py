import regnf

box = regnf.OrientedBox.from_corners([-0.84, -0.59, -0.50], [-0.29, 0.02, 0.02])
result = regnf.register("examples/data/mix-room.safetensors", "examples/data/armchair.safetensors", box)
print(result.verdict, result.scale)
print(result.T_scene_object.matrix())  # the object's pose in the scene
result.save("out")
