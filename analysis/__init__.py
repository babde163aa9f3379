"""After the flight: evaluation, identification of lags, report."""
