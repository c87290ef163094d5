"""A plugin as a third party would write it: one good plane detector, several bad methods."""
