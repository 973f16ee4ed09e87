"""Points picked in the scan and in photographs, side by side in the browser."""
