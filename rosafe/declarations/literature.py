"""The publications that the built-in representations and their validation cite, in the order of the authors' names."""

from __future__ import annotations

from rosafe.declarations.reference import Reference

_JASA = "Journal of the Acoustical Society of America"
_ICASSP = "Proceedings of the IEEE International Conference on Acoustics, Speech, and Signal Processing"

BACKUS_2006 = Reference(
    "backus2006",
    "article",
    "Backus, B. C. and Guinan, J. J.",
    2006,
    "Time-course of the human medial olivocochlear reflex",
    _JASA,
    "119",
    "2889-2904",
    doi="10.1121/1.2169918",
)
BERNSTEIN_1999 = Reference(
    "bernstein1999",
    "article",
    "Bernstein, L. R. and van de Par, S. and Trahiotis, C.",
    1999,
    "The normalized interaural correlation: accounting for NoSπ thresholds obtained with Gaussian and "
    "'low-noise' masking noise",
    _JASA,
    "106",
    "870-876",
)
BRAASCH_2013 = Reference(
    "braasch2013",
    "article",
    "Braasch, J.",
    2013,
    "A precedence effect model to simulate localization dominance using an adaptive, stimulus "
    "parameter-based inhibition process",
    _JASA,
    "134",
    "420-435",
    doi="10.1121/1.4807829",
)
BREEBAART_2001 = Reference(
    "breebaart2001",
    "article",
    "Breebaart, J. and van de Par, S. and Kohlrausch, A.",
    2001,
    "Binaural processing model based on contralateral inhibition. I. Model structure",
    _JASA,
    "110",
    "1074-1088",
    doi="10.1121/1.1383297",
)
BREGMAN_1990 = Reference(
    "bregman1990",
    "book",
    "Bregman, A. S.",
    1990,
    "Auditory scene analysis: the perceptual organization of sound",
    "MIT Press",
    doi="10.7551/mitpress/1486.001.0001",
)
BROWN_1994 = Reference(
    "brown1994",
    "article",
    "Brown, G. J. and Cooke, M.",
    1994,
    "Computational auditory scene analysis",
    "Computer Speech and Language",
    "8",
    "297-336",
    doi="10.1006/csla.1994.1016",
)
CLARK_2012 = Reference(
    "clark2012",
    "article",
    "Clark, N. R. and Brown, G. J. and Jürgens, T. and Meddis, R.",
    2012,
    "A frequency-selective feedback model of auditory efferent suppression and its implications for the "
    "recognition of speech in noise",
    _JASA,
    "132",
    "1535-1541",
    doi="10.1121/1.4742745",
)
DAU_1996 = Reference(
    "dau1996",
    "article",
    "Dau, T. and Püschel, D. and Kohlrausch, A.",
    1996,
    "A quantitative model of the 'effective' signal processing in the auditory system. I. Model structure",
    _JASA,
    "99",
    "3615-3622",
    doi="10.1121/1.414959",
)
DAU_1997 = Reference(
    "dau1997",
    "article",
    "Dau, T. and Kollmeier, B. and Kohlrausch, A.",
    1997,
    "Modeling auditory processing of amplitude modulation. I. Detection and masking with narrow-band carriers",
    _JASA,
    "102",
    "2892-2905",
    doi="10.1121/1.420344",
)
VANDORP_2013 = Reference(
    "vandorp2013",
    "article",
    "van Dorp Schuitman, J. and de Vries, D. and Lindau, A.",
    2013,
    "Deriving content-specific measures of room acoustic perception using a binaural, nonlinear auditory model",
    _JASA,
    "133",
    "1572-1585",
    doi="10.1121/1.4789357",
)
EWERT_2000 = Reference(
    "ewert2000",
    "article",
    "Ewert, S. D. and Dau, T.",
    2000,
    "Characterizing frequency selectivity for envelope fluctuations",
    _JASA,
    "108",
    "1181-1196",
    doi="10.1121/1.1288665",
)
FALLER_2004 = Reference(
    "faller2004",
    "article",
    "Faller, C. and Merimaa, J.",
    2004,
    "Source localization in complex listening situations: selection of binaural cues based on interaural coherence",
    _JASA,
    "116",
    "3075-3089",
    doi="10.1121/1.1791872",
)
GARDNER_1995 = Reference(
    "gardner1995",
    "article",
    "Gardner, W. G. and Martin, K. D.",
    1995,
    "HRTF measurements of a KEMAR",
    _JASA,
    "97",
    "3907-3908",
    doi="10.1121/1.412407",
)
GLASBERG_1990 = Reference(
    "glasberg1990",
    "article",
    "Glasberg, B. R. and Moore, B. C. J.",
    1990,
    "Derivation of auditory filter shapes from notched-noise data",
    "Hearing Research",
    "47",
    "103-138",
    doi="10.1016/0378-5955(90)90170-T",
)
GOODE_1994 = Reference(
    "goode1994",
    "article",
    "Goode, R. L. and Killion, M. and Nakamura, K. and Nishihara, S.",
    1994,
    "New knowledge about the function of the human middle ear: development of an improved analog model",
    "American Journal of Otology",
    "15",
    "145-154",
)
HOHMANN_2002 = Reference(
    "hohmann2002",
    "article",
    "Hohmann, V.",
    2002,
    "Frequency analysis and synthesis using a Gammatone filterbank",
    "Acta Acustica united with Acustica",
    "88",
    "433-442",
)
JENSEN_2004 = Reference(
    "jensen2004",
    "incollection",
    "Jensen, K. and Andersen, T. H.",
    2004,
    "Real-time beat estimation using feature extraction",
    "Computer Music Modeling and Retrieval, LNCS 2771, Springer",
    "",
    "13-22",
)
JEPSEN_2008 = Reference(
    "jepsen2008",
    "article",
    "Jepsen, M. L. and Ewert, S. D. and Dau, T.",
    2008,
    "A computational model of human auditory signal processing and perception",
    _JASA,
    "124",
    "422-438",
    doi="10.1121/1.2924135",
)
JORGENSEN_2011 = Reference(
    "jorgensen2011",
    "article",
    "Jørgensen, S. and Dau, T.",
    2011,
    "Predicting speech intelligibility based on the signal-to-noise envelope power ratio after "
    "modulation-frequency selective processing",
    _JASA,
    "130",
    "1475-1487",
    doi="10.1121/1.3621502",
)
KIM_2009 = Reference(
    "kim2009",
    "article",
    "Kim, G. and Lu, Y. and Hu, Y. and Loizou, P. C.",
    2009,
    "An algorithm that improves speech intelligibility in noise for normal-hearing listeners",
    _JASA,
    "126",
    "1486-1494",
    doi="10.1121/1.3184603",
)
KLAPURI_1999 = Reference(
    "klapuri1999",
    "inproceedings",
    "Klapuri, A.",
    1999,
    "Sound onset detection by applying psychoacoustic knowledge",
    _ICASSP,
    "",
    "3089-3092",
    doi="10.1109/ICASSP.1999.757494",
)
KOLLMEIER_1994 = Reference(
    "kollmeier1994",
    "article",
    "Kollmeier, B. and Koch, R.",
    1994,
    "Speech enhancement based on physiological and psychoacoustical models of modulation perception and "
    "binaural interaction",
    _JASA,
    "95",
    "1593-1602",
    doi="10.1121/1.408546",
)
KUHN_1977 = Reference(
    "kuhn1977",
    "article",
    "Kuhn, G. F.",
    1977,
    "Model for the interaural time differences in the azimuthal plane",
    _JASA,
    "62",
    "157-167",
    doi="10.1121/1.381498",
)
LERCH_2012 = Reference(
    "lerch2012",
    "book",
    "Lerch, A.",
    2012,
    "An introduction to audio content analysis: applications in signal processing and music informatics",
    "Wiley",
    doi="10.1002/9781118393550",
)
LIBERMAN_1988 = Reference(
    "liberman1988",
    "article",
    "Liberman, M. C.",
    1988,
    "Response properties of cochlear efferent neurons: monaural vs. binaural stimulation and the effects of noise",
    "Journal of Neurophysiology",
    "60",
    "1779-1798",
)
LICKLIDER_1951 = Reference(
    "licklider1951",
    "article",
    "Licklider, J. C. R.",
    1951,
    "A duplex theory of pitch perception",
    "Experientia",
    "7",
    "128-134",
    doi="10.1007/BF02156143",
)
LOPEZPOVEDA_2001 = Reference(
    "lopezpoveda2001",
    "article",
    "Lopez-Poveda, E. A. and Meddis, R.",
    2001,
    "A human nonlinear cochlear filterbank",
    _JASA,
    "110",
    "3107-3118",
    doi="10.1121/1.1416197",
)
MAJDAK_2022 = Reference(
    "majdak2022",
    "article",
    "Majdak, P. and Hollomey, C. and Baumgartner, R.",
    2022,
    "AMT 1.x: A toolbox for reproducible research in auditory modeling",
    "Acta Acustica",
    "6",
    "19",
    doi="10.1051/aacus/2022011",
)
MAY_2011 = Reference(
    "may2011",
    "article",
    "May, T. and van de Par, S. and Kohlrausch, A.",
    2011,
    "A probabilistic model for robust localization based on a binaural auditory front-end",
    "IEEE Transactions on Audio, Speech, and Language Processing",
    "19",
    "1-13",
    doi="10.1109/TASL.2010.2042128",
)
MAY_2014 = Reference(
    "may2014",
    "article",
    "May, T. and Dau, T.",
    2014,
    "Computational speech segregation based on an auditory-inspired modulation analysis",
    _JASA,
    "136",
    "3350-3359",
    doi="10.1121/1.4901711",
)
MEDDIS_1991 = Reference(
    "meddis1991",
    "article",
    "Meddis, R. and Hewitt, M. J.",
    1991,
    "Virtual pitch and phase sensitivity of a computer model of the auditory periphery. I: Pitch identification",
    _JASA,
    "89",
    "2866-2882",
    doi="10.1121/1.400725",
)
MEDDIS_1997 = Reference(
    "meddis1997",
    "article",
    "Meddis, R. and O'Mard, L.",
    1997,
    "A unitary model of pitch perception",
    _JASA,
    "102",
    "1811-1820",
    doi="10.1121/1.420088",
)
MISRA_2004 = Reference(
    "misra2004",
    "inproceedings",
    "Misra, H. and Ikbal, S. and Bourlard, H. and Hermansky, H.",
    2004,
    "Spectral entropy based feature for robust ASR",
    _ICASSP,
    "",
    "193-196",
    doi="10.1109/ICASSP.2004.1325955",
)
PATTERSON_1987 = Reference(
    "patterson1987",
    "techreport",
    "Patterson, R. D. and Nimmo-Smith, I. and Holdsworth, J. and Rice, P.",
    1987,
    "An efficient auditory filterbank based on the gammatone function",
    "MRC Applied Psychology Unit, Cambridge",
    note="APU report 2341",
)
PEETERS_2011 = Reference(
    "peeters2011",
    "article",
    "Peeters, G. and Giordano, B. L. and Susini, P. and Misdariis, N. and McAdams, S.",
    2011,
    "The Timbre Toolbox: extracting audio descriptors from musical signals",
    _JASA,
    "130",
    "2902-2916",
    doi="10.1121/1.3642604",
)
PUSCHEL_1988 = Reference(
    "puschel1988",
    "phdthesis",
    "Püschel, D.",
    1988,
    "Prinzipien der zeitlichen Analyse beim Hören",
    "Universität Göttingen",
    note="doctoral thesis",
)
QIU_2003 = Reference(
    "qiu2003",
    "article",
    "Qiu, A. and Schreiner, C. E. and Escabí, M. A.",
    2003,
    "Gabor analysis of auditory midbrain receptive fields: spectro-temporal and binaural composition",
    "Journal of Neurophysiology",
    "90",
    "456-476",
    doi="10.1152/jn.00851.2002",
)
RABINER_1977 = Reference(
    "rabiner1977",
    "article",
    "Rabiner, L. R.",
    1977,
    "On the use of autocorrelation analysis for pitch detection",
    "IEEE Transactions on Acoustics, Speech, and Signal Processing",
    "25",
    "24-33",
    doi="10.1109/TASSP.1977.1162905",
)
SCHADLER_2012 = Reference(
    "schadler2012",
    "article",
    "Schädler, M. R. and Meyer, B. T. and Kollmeier, B.",
    2012,
    "Spectro-temporal modulation subspace-spanning filter bank features for robust automatic speech recognition",
    _JASA,
    "131",
    "4134-4151",
    doi="10.1121/1.3699200",
)
SCHEIRER_1997 = Reference(
    "scheirer1997",
    "inproceedings",
    "Scheirer, E. and Slaney, M.",
    1997,
    "Construction and evaluation of a robust multifeature speech/music discriminator",
    _ICASSP,
    "",
    "1331-1334",
    doi="10.1109/ICASSP.1997.596192",
)
SLANEY_1990 = Reference(
    "slaney1990",
    "inproceedings",
    "Slaney, M. and Lyon, R. F.",
    1990,
    "A perceptual pitch detector",
    _ICASSP,
    "",
    "357-360",
    doi="10.1109/ICASSP.1990.115684",
)
SLANEY_1993 = Reference(
    "slaney1993",
    "techreport",
    "Slaney, M.",
    1993,
    "An efficient implementation of the Patterson-Holdsworth auditory filter bank",
    "Apple Computer",
    note="Technical report 35",
)
STERN_1988 = Reference(
    "stern1988",
    "article",
    "Stern, R. M. and Zeiberg, A. S. and Trahiotis, C.",
    1988,
    "Lateralization of complex binaural stimuli: a weighted-image model",
    _JASA,
    "84",
    "156-165",
)
TCHORZ_2003 = Reference(
    "tchorz2003",
    "article",
    "Tchorz, J. and Kollmeier, B.",
    2003,
    "SNR estimation based on amplitude modulation analysis with applications to noise suppression",
    "IEEE Transactions on Speech and Audio Processing",
    "11",
    "184-192",
    doi="10.1109/TSA.2003.811542",
)
TERHARDT_1979 = Reference(
    "terhardt1979",
    "article",
    "Terhardt, E.",
    1979,
    "Calculating virtual pitch",
    "Hearing Research",
    "1",
    "155-182",
    doi="10.1016/0378-5955(79)90025-X",
)
TOLONEN_2000 = Reference(
    "tolonen2000",
    "article",
    "Tolonen, T. and Karjalainen, M.",
    2000,
    "A computationally efficient multipitch analysis model",
    "IEEE Transactions on Speech and Audio Processing",
    "8",
    "708-716",
    doi="10.1109/89.876309",
)
TURGEON_2002 = Reference(
    "turgeon2002",
    "article",
    "Turgeon, M. and Bregman, A. S. and Ahad, P. A.",
    2002,
    "Rhythmic masking release: contribution of cues for perceptual organization to the cross-spectral "
    "fusion of concurrent narrow-band noises",
    _JASA,
    "111",
    "1819-1831",
)
TWOEARS_2018 = Reference(
    "twoears2018",
    "software",
    "{The Two!Ears project}",
    2018,
    "Two!Ears auditory model 1.5",
    "Zenodo",
    doi="10.5281/zenodo.1458420",
)
TZANETAKIS_2002 = Reference(
    "tzanetakis2002",
    "article",
    "Tzanetakis, G. and Cook, P.",
    2002,
    "Musical genre classification of audio signals",
    "IEEE Transactions on Speech and Audio Processing",
    "10",
    "293-302",
    doi="10.1109/TSA.2002.800560",
)
WALLACH_1949 = Reference(
    "wallach1949",
    "article",
    "Wallach, H. and Newman, E. B. and Rosenzweig, M. R.",
    1949,
    "The precedence effect in sound localization",
    "American Journal of Psychology",
    "62",
    "315-336",
    doi="10.2307/1418275",
)
WOODWORTH_1938 = Reference(
    "woodworth1938",
    "book",
    "Woodworth, R. S.",
    1938,
    "Experimental psychology",
    "Holt",
)
YOUNG_2006 = Reference(
    "young2006",
    "book",
    "Young, S. and others",
    2006,
    "The HTK book",
    "Cambridge University Engineering Department",
)

LITERATURE = {value.key: value for value in tuple(globals().values()) if isinstance(value, Reference)}
