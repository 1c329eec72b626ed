"""The text menu (human-machine interface): screens, telnet, the seat."""
