"""How sure a fitted arm is: the spread its parameters leave, and the errors to expect of it anywhere."""
