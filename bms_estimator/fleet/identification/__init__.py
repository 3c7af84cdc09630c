"""Re-identification of cells from captured blocks."""
