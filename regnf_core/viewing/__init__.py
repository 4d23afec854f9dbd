"""What people look at: the files of a registration, pictures, recordings, views of a field."""
