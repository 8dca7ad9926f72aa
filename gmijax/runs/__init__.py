"""What jobs leave on the disk, and where they find it again."""
