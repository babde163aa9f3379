"""What a flight's own record says of its sprayer: lags by kind, from orders and the flow meter."""
