"""What reports have in common: a page of HTML with everything in it, its pictures, and files that are whole."""
