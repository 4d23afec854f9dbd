"""What is deployed beside the images: board, alerts, chart."""
