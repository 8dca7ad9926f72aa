"""Messages between processes, and experience channels made of them (paper, section 4.2)."""
