"""One large scene in blocks: trained from a coarse run of all of it, merged, and measured along the seams."""
