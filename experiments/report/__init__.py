"""What every study shows: figures with intervals, tables, plots, clips, and a page that opens offline."""
