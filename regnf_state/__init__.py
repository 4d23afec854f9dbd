"""What the front end and the workers share: records, storage, queue, settings. Neither HTTP nor torch."""
