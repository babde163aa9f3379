"""All that can be said of a flown flight: intervals, breakdowns, cells, causes, balance."""
