"""What is known of a library object before any scene: samples, symmetries, signature."""
