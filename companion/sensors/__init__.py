"""What measures the liquid: flow meter, pressure, tank. A sensor that fails says so, never zero."""
