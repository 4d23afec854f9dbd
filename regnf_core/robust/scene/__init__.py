"""What a detection box shows of a scene: foreground samples, support planes, occlusion boundaries."""
