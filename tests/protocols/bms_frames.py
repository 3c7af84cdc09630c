"""Frames of real BMS from public repositories, with the values that the authors of the repositories decoded."""

from typing import NamedTuple


class PublishedCycle(NamedTuple):
    """Responses of one poll cycle, and their values. The current is positive on discharge, the temperature the mean of the probes."""

    protocol: str
    frames: bytes
    voltage_v: float
    current_a: float
    temperature_c: float
    cells_v: list[float]
    description: str


JBD_NAME = bytes.fromhex("dd050019 4a42442d53503034533033342d4c34532d323030412d422d55 fa0877")
JBD_CELLS = bytes.fromhex("dd040008 0f450f3d0f370f3d fec677")
JBD_BASIC = bytes.fromhex("dd03001d 0618000001f201f400002c7c00000000000080640304030b8b0b8a0b84 fa8d77")

JBD = PublishedCycle("jbd", JBD_NAME + JBD_CELLS + JBD_BASIC, 15.6, 0.0, 22.133, [3.909, 3.901, 3.895, 3.901],
                "JBD BMS JBD-SP04S034-L4S-200A-B-U, 4 cells")  # fmt: skip
"""syssi/esphome-jbd-bms, docs/pdus/JBD-SP04S034-L4S-200A-B-U.txt."""

JBD_DISCHARGING = PublishedCycle(
    "jbd",
    bytes.fromhex("dd040008 0d660d610d680d59 fe3c77")
    + bytes.fromhex("dd03001d 0618fee101f201f4002a2c7c00000000000080640304030b8b0b8a0b84 f88477"),
    15.6, 2.87, 22.133, [3.43, 3.425, 3.432, 3.417], "JBD BMS, 4 cells",
)  # fmt: skip
"""patman15/aiobmsble, tests/bms/test_jbd_bms.py: the BMS reports -2.87 A and is not charging."""

JBD_WITHOUT_PROBES = bytes.fromhex("dd030017 000000000000271000002c5000000000000020000110 00ff0577")
"""syssi/esphome-jbd-bms, docs/pdus/JBD-SP25S003-L16S-100A-100A-B.txt: a BMS without temperature probes."""

DALY_STATUS = bytes.fromhex("a5019408 1001000002000b9b fb")
DALY_CELLS = bytes.fromhex(
    "a5019508 010d370d360d349b a7 a5019508 020d350d350d359b a6 a5019508 030d340d3e0d369b b0"
    "a5019508 040d370d360d379b ad a5019508 050d340d350d349b a7 a5019508 060d37000000009b 28"
    "a5019508 07000000000000 9b e5 a5019508 08000000000000 9b e6"
)
DALY_PROBES = bytes.fromhex("a5019608 013d000000000000 82 a5019608 0200000000000000 46")
DALY_PACK = bytes.fromhex("a5019008 0212000074f5039a 58")

DALY = PublishedCycle(
    "daly", DALY_STATUS + DALY_CELLS + DALY_PROBES + DALY_PACK, 53.0, -5.9, 21.0,
    [3.383, 3.382, 3.380, 3.381, 3.381, 3.381, 3.380, 3.390, 3.382, 3.383, 3.382, 3.383, 3.380, 3.381, 3.380, 3.383],
    "Daly BMS, 16 cells",
)  # fmt: skip
"""dreadnought/python-daly-bms, tests/test_bluetooth.py: "negative=charging, positive=discharging"."""

JK_OLD = PublishedCycle(
    "jk",
    bytes.fromhex(
        "4e57011b00000000060001 792a 010eed 020efa 030ef7 040eec 050ef8 060efa 070ef1 080ef8 090ee3 0a0efa 0b0ef1"
        "0c0efb 0d0efb 0e0ef2 80001d 81001e 82001c 8314ef 8480d0 850f 8602 870004 8900000000 8a000e 8b0000 8c0007"
        "8e1626 8f10ae 900fd2 910fa0 920005 930bea 940c1c 950005 96012c 970007 980003 990005 9a0005 9b0ce4 9c0008"
        "9d01 9e005a 9f0046 a00064 a10064 a20014 a30046 a40046 a5ffec a6fff6 a7ffec a8fff6 a90e aa0000000e ab01"
        "ac01 ad0411 ae01 af01 b0000a b114 b231323334353600000000 b300 b4496e707574205573 b532313031 b60000e200"
        "b748362e585f5f53362e312e33535f5f b800 b900000000 ba425433303732303230313230303030323030353231303031 c001"
        "00000000 68 000054d1"
    ),
    53.59, -2.08, 29.0,
    [3.821, 3.834, 3.831, 3.820, 3.832, 3.834, 3.825, 3.832, 3.811, 3.834, 3.825, 3.835, 3.835, 3.826],
    "JK-BMS, 14 cells, software H6.X__S6.1.3S",
)  # fmt: skip
"""syssi/esphome-jk-bms, docs/protocol-design-uart-ttl-gps-port.md and tests/components/jk_bms: charging with 2.08 A."""

JK_NEWER_FRAME = bytes.fromhex(
    "55aaeb9002e8ae0c9e0c9a0c9f0ca10c9f0ca00ca00c990ca00c900c990ca50c9f0c990caa0c000000000000000000000000"
    "0000000000000000000000000000000000000000ffff00009f0c1f00000a680068007a007300720085007000670082007700"
    "650066007e00780074009c000000000000000000000000000000000000000000000000000000000000000000ad0000000000"
    "e9c900000000000000000000b100b100000000000000003413040000d007000000000000000000006400000098a301000101"
    "0000000000000000000000000000ff0001000000e20400000100f6c74040000000003014fe010001010100060000600c0000"
    "00000000ad00b300b4009003da269d07180600008051010000000000000000000000000000feff7fdd2f0101b00700000016"
)
"""syssi/esphome-jk-bms, tests/components/jk_bms_ble/frames_jk02_32s_v11.h: a JK_PB2A16S15P.

The frames on Bluetooth and on RS485 are equal.
"""
JK_RECORD_OF_PACK_2 = bytes.fromhex("0210162000010478")
"""Record that follows the newer frame on RS485: eggcho/jk-bms-passive-bridge, README."""

JK_NEWER = PublishedCycle(
    "jk", JK_NEWER_FRAME + JK_RECORD_OF_PACK_2, 51.689, 0.0, 17.825,
    [3.246, 3.230, 3.226, 3.231, 3.233, 3.231, 3.232, 3.232, 3.225, 3.232, 3.216, 3.225, 3.237, 3.231, 3.225, 3.242],
    "JK-BMS, 16 cells, pack 2",
)  # fmt: skip

PUBLISHED = {"jbd": JBD, "jbd_discharging": JBD_DISCHARGING, "daly": DALY, "jk_old": JK_OLD, "jk_newer": JK_NEWER}
