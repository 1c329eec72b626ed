"""The screens of the menu: one dialogue for each key of the main menu; ``main`` knows them all."""
