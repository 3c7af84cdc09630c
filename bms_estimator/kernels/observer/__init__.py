"""The thesis's adaptive observer: Nussbaum gain, Mittag-Leffler function, adaptive law."""
