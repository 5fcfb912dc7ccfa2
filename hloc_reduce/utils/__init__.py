"""What knows nothing of localization: files, images, command lines, COLMAP, hloc."""
