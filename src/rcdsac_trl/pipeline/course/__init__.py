"""The office course: a trained agent on a robot as it would be built, in a simulated office of 53.7 m and back."""
