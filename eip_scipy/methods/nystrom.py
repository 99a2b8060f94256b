"""Explicit Runge-Kutta-Nystrom tableaux for q'' = a(t, q).

User-defined tableaux are checked against the order conditions when they are created; those of the package are checked
by its tests.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from itertools import combinations_with_replacement
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from .orders import Ordered, named_constant
from .runge_kutta import FLOAT_TOLERANCE, Number, _check_integer, _low_parts, _stage_matrix, _vector

__all__ = ["RKN86", "RKN1210", "NystromTableau"]

# Order conditions are summed in integers of 2**-256 (77 digits), because fractions would accumulate the denominators of
# all stages.
FIXED_BITS = 256
# The published fractions of RKN1210 miss the conditions by 2e-54; floats by 1e-16 times the size of the coefficients.
TOLERANCE = 1e-50
# With more than seven moments the corrections would exceed the rounding errors, and a step would not resolve them.
MOMENTS = 7


class NystromTree(NamedTuple):
    """A special Nystrom tree with an acceleration as root: the number of leaves, which are velocities, and subtrees."""

    leaves: int
    subtrees: tuple[NystromTree, ...]


@cache
def nystrom_trees(order: int) -> tuple[NystromTree, ...]:
    """Return all special Nystrom trees with `order` vertices (Hairer, Norsett & Wanner I, section II.14)."""
    forests = _forests(order - 1, order - 1)
    return tuple(NystromTree(order - 1 - sum(1 + _size(sub) for sub in forest), forest) for forest in forests)


def _forests(vertices: int, largest: int) -> Iterator[tuple[NystromTree, ...]]:
    """Yield the multisets of trees with at most `vertices` vertices in total and at most `largest` vertices per tree.

    Each tree counts with one more vertex, which joins it to the root.
    """
    if largest < 2:
        yield ()
        return
    for count in range(vertices // largest + 1):
        for group in combinations_with_replacement(nystrom_trees(largest - 1), count):
            for rest in _forests(vertices - count * largest, largest - 1):
                yield (*group, *rest)


@cache
def _size(tree: NystromTree) -> int:
    return 1 + tree.leaves + sum(1 + _size(sub) for sub in tree.subtrees)


@cache
def _density(tree: NystromTree) -> int:
    """Return the density of a tree: 1 / density is the weight of the tree in the velocity of the exact solution."""
    product = _size(tree)
    for sub in tree.subtrees:
        product *= (1 + _size(sub)) * _density(sub)
    return product


def _fixed(values: np.ndarray) -> np.ndarray:
    """Return numbers as integers in units of ``2**-FIXED_BITS``."""
    integers = np.empty(values.shape, dtype=object)
    for place, value in np.ndenumerate(values):
        exact = Fraction(value)
        integers[place] = (exact.numerator << FIXED_BITS) // exact.denominator
    return integers


class Weights(NamedTuple):
    """Weights of the position (if `position`) or of the velocity, their name, and the order that they must have."""

    label: str
    values: np.ndarray
    order: int
    position: bool


def nystrom_residuals(A: np.ndarray, c: np.ndarray, rows: Sequence[Weights]) -> Iterator[tuple[Weights, int, float]]:
    """Yield (row, vertices, residual) for each order condition up to the order of each row of weights.

    `vertices` is the number of vertices of the condition's tree.

    For a velocity the residuals are sum_i b'_i phi_i(tree) - 1 / density(tree), for trees of up to `order` vertices.
    For a position they are sum_i b_i phi_i(tree) - 1 / ((vertices + 1) density(tree)), for trees of up to one vertex
    less. phi_i(tree) is c_i^leaves times the product of sum_j A_ij phi_j(subtree) over all subtrees.
    """
    A, c = _fixed(A), _fixed(c)
    weights = [_fixed(row.values) for row in rows]
    branches: dict[NystromTree, np.ndarray] = {}

    def stage_factors(tree: NystromTree) -> np.ndarray:
        factors = np.full(len(c), 1 << FIXED_BITS, dtype=object)
        for _ in range(tree.leaves):
            factors = factors * c >> FIXED_BITS
        for sub in tree.subtrees:
            if sub not in branches:
                branches[sub] = A.dot(stage_factors(sub)) >> FIXED_BITS
            factors = factors * branches[sub] >> FIXED_BITS
        return factors

    for vertices in range(1, max(row.order for row in rows) + 1):
        for tree in nystrom_trees(vertices):
            factors = stage_factors(tree)
            for row, values in zip(rows, weights, strict=True):
                if vertices + row.position <= row.order:
                    exact = (1 << FIXED_BITS) // (_density(tree) * (1 + vertices * row.position))
                    yield row, vertices, ((values.dot(factors) >> FIXED_BITS) - exact) / (1 << FIXED_BITS)


@dataclass(frozen=True, eq=False)
class NystromTableau(Ordered):
    """Coefficients of an explicit Runge-Kutta-Nystrom method for q'' = a(t, q).

    With the accelerations k_i = a(t + c_i h, Q_i) at the stages Q_i = q + c_i h v + h^2 sum_j A_ij k_j, a step is
    q + h v + h^2 sum_i b_i k_i and v + h sum_i b'_i k_i.

    Parameters
    ----------
    name : str
        Name of the method.
    A : sequence of sequences
        Strictly lower triangular stage matrix; row i needs only its first i entries. Entries are int, Fraction,
        strings such as ``"1/3"`` (exact) or floats.
    b, b_prime : sequence, length s
        Weights of the position and of the velocity.
    c : sequence, length s
        Nodes.
    order : int
        Order of the step, checked against every order condition: to 1e-50 for rational entries, to 1e-12 for floats.
    b_hat, b_prime_hat : sequence, length s, optional
        Weights of the embedded estimate; both or none. (In the papers the hat denotes the step, not the estimate.)
    error_estimator_order : int, optional
        Order of the estimate, checked in the same way; required with `b_hat`.
    reference : str
        Source of the coefficients, including the table.

    Attributes
    ----------
    A, b, b_prime, c : ndarray of float64
        (s, s), (s,), (s,), (s,).
    b_hat, b_prime_hat : ndarray of float64, shape (s,), or None
    e, e_prime : ndarray of float64, shape (s,)
        Weights of the error estimate, ``b - b_hat`` and ``b_prime - b_prime_hat``; zero without an estimate.
    b_low, b_prime_low : ndarray of float64, shape (s,)
        Rounding errors of `b` and `b_prime` in double precision, for compensated summation, corrected as follows. The
        step uses rounded nodes, with which even exact weights violate the quadrature conditions by 1e-17, with the same
        sign in each step; therefore the low parts make the first moments exact for the rounded nodes. The number of
        these moments is at most seven, at most `order`, and at most the number of distinct nodes whose weights are not
        zero. Weights of zero stay zero.
    exact : mapping from str to ndarray of object
        A, b, b_prime, c and, if given, b_hat and b_prime_hat, as fractions (floats where floats were given).
    n_stages : int
        Number of stages.
    fsal : bool
        True if the last stage is only used by the error estimate, and is the first stage of the next step.

    Raises
    ------
    ValueError
        If the tableau is not explicit, its first stage is not at the start of the step, shapes disagree, or an order
        condition fails.
    """

    of_second_order = True

    name: str
    A: np.ndarray
    b: np.ndarray
    b_prime: np.ndarray
    c: np.ndarray
    order: int
    b_hat: np.ndarray | None = None
    b_prime_hat: np.ndarray | None = None
    error_estimator_order: int | None = None
    reference: str = ""
    e: np.ndarray = field(init=False)
    e_prime: np.ndarray = field(init=False)
    b_low: np.ndarray = field(init=False)
    b_prime_low: np.ndarray = field(init=False)
    exact: Mapping[str, np.ndarray] = field(init=False)
    n_stages: int = field(init=False)
    fsal: bool = field(init=False)

    def __init__(
        self,
        name: str,
        A: Sequence[Sequence[Number]],
        b: Sequence[Number],
        b_prime: Sequence[Number],
        c: Sequence[Number],
        order: int,
        *,
        b_hat: Sequence[Number] | None = None,
        b_prime_hat: Sequence[Number] | None = None,
        error_estimator_order: int | None = None,
        reference: str = "",
    ) -> None:
        _check_integer(name, "order", order)
        given = {"b": b, "b_prime": b_prime, "c": c}
        if b_hat is not None and b_prime_hat is not None and error_estimator_order is not None:
            _check_integer(name, "error_estimator_order", error_estimator_order)
            given |= {"b_hat": b_hat, "b_prime_hat": b_prime_hat}
        elif any(value is not None for value in (b_hat, b_prime_hat, error_estimator_order)):
            raise ValueError(
                f"{name}: give all or none of b_hat, b_prime_hat and error_estimator_order; some are missing."
            )
        s = len(b)
        exact = {"A": _stage_matrix(name, A, s), **{key: _row(name, key, row, s) for key, row in given.items()}}
        rows = [Weights("b", exact["b"], order, True), Weights("b_prime", exact["b_prime"], order, False)]
        if error_estimator_order is not None:
            rows.append(Weights("b_hat", exact["b_hat"], error_estimator_order, True))
            rows.append(Weights("b_prime_hat", exact["b_prime_hat"], error_estimator_order, False))
        if exact["c"][0] != 0:
            raise ValueError(
                f"{name}: the first node is {exact['c'][0]}, expected 0: the first stage is at the start of the step."
            )
        self._check_order(name, exact["A"], exact["c"], rows)
        self._set(name=name, order=order, error_estimator_order=error_estimator_order, reference=reference)
        # The last stage may be at the new position and time, without being used by the step.
        unused = exact["c"][-1] == 1 and exact["b"][-1] == 0 and exact["b_prime"][-1] == 0
        fsal = bool(unused and np.array_equal(exact["A"][-1], exact["b"]))
        self._set(b_hat=None, b_prime_hat=None, exact=MappingProxyType(exact), n_stages=s, fsal=fsal)
        self._set(**{key: values.astype(float) for key, values in exact.items()})
        self._set(e=_difference(exact, "b"), e_prime=_difference(exact, "b_prime"))
        # Values that a method of this order requires of sum_i b_i c_i^k and of sum_i b'_i c_i^k, k = 0, 1, ...
        positions = [Fraction(1, (k + 1) * (k + 2)) for k in range(min(order - 1, MOMENTS))]
        velocities = [Fraction(1, k + 1) for k in range(min(order, MOMENTS))]
        self._set(b_low=_low_parts_of_used(exact["b"], exact["c"], positions))
        self._set(b_prime_low=_low_parts_of_used(exact["b_prime"], exact["c"], velocities))
        for values in exact.values():
            values.setflags(write=False)

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, key, value)

    @staticmethod
    def _check_order(name: str, A: np.ndarray, c: np.ndarray, rows: Sequence[Weights]) -> None:
        entries = (*A.ravel(), *c, *(value for row in rows for value in row.values))
        tolerance = FLOAT_TOLERANCE if any(isinstance(value, float) for value in entries) else TOLERANCE
        for row, vertices, residual in nystrom_residuals(A, c, rows):
            if abs(residual) > tolerance:
                raise ValueError(
                    f"{name}: {row.label} is not of order {row.order}: a condition of order {vertices + row.position} "
                    f"is violated by {residual:.3g}."
                )

    def __reduce_ex__(self, protocol: Any) -> Any:
        return named_constant(self, globals()) or super().__reduce_ex__(protocol)

    def __repr__(self) -> str:
        estimate = f", estimate of order {self.error_estimator_order}" if self.has_estimate else ""
        return f"<NystromTableau {self.name}: {self.n_stages} stages, order {self.order}{estimate}>"


def _row(name: str, label: str, values: Sequence[Number], s: int) -> np.ndarray:
    if len(values) != s:
        raise ValueError(f"{name}: {label} has {len(values)} entries and b has {s}; they must have the same number.")
    return _vector(name, values)


def _difference(exact: Mapping[str, np.ndarray], key: str) -> np.ndarray:
    """Return the weights `key` minus those of the estimate, rounded once; 0 without an estimate."""
    if f"{key}_hat" not in exact:
        return np.zeros(len(exact[key]))
    pairs = zip(exact[key], exact[f"{key}_hat"], strict=True)
    return np.array([float(Fraction(x) - Fraction(y)) for x, y in pairs])


def _low_parts_of_used(b: np.ndarray, c: np.ndarray, moments: Sequence[Fraction]) -> np.ndarray:
    """Return the output of `_low_parts` for those weights `b` that are not zero, and 0 for the others."""
    used = np.array([x != 0 for x in b])
    low = np.zeros(len(b))
    low[used] = _low_parts(b[used], c[used], moments)
    return low


class _Published(NystromTableau):
    """A tableau of this package, whose order is checked by the tests instead of at each import.

    The check of the 800 trees of RKN1210 alone would take 60 ms.
    """

    @staticmethod
    def _check_order(name: str, A: np.ndarray, c: np.ndarray, rows: Sequence[Weights]) -> None:
        pass

    def __reduce__(self) -> str:
        return self.name  # of the variable too: exact fractions need not travel, and problems that have one pickle


def _fractions(text: str) -> list[str]:
    """Return the entries of a row, which may be broken after a slash."""
    return re.sub(r"/\s+", "/", text).split()


RKN86 = _Published(
    "RKN86",
    [
        [],
        ["1/800"],
        ["1/600", "1/300"],
        ["9/200", "-9/100", "9/100"],
        ["-66701/197352", "28325/32892", "-2665/5482", "2170/24669"],
        ["227015747/304251000", "-54897451/30425100", "12942349/10141700", "-9499/304251", "539/9250"],
        ["-1131891597/901789000", "41964921/12882700", "-6663147/3220675", "270954/644135", "-108/5875", "114/1645"],
        _fractions("""
            13836959/3667458 -17731450/1833729 1063919505/156478208 -33213845/39119552 13335/28544 -705/14272 1645/57088
        """),
        ["223/7938", 0, "1175/8064", "925/6048", "41/448", "925/14112", "1175/72576"],
    ],
    ["223/7938", 0, "1175/8064", "925/6048", "41/448", "925/14112", "1175/72576", 0, 0],
    ["223/7938", 0, "5875/36288", "4625/21168", "41/224", "4625/21168", "5875/36288", "223/7938", 0],
    [0, "1/20", "1/10", "3/10", "1/2", "7/10", "9/10", 1, 1],
    order=8,
    b_hat=_fractions("""
        7987313/109941300 0 1610737/44674560 10023263/33505920 -497221/12409600 10023263/78180480 1610737/402071040 0 0
    """),
    b_prime_hat=_fractions("""
        7987313/109941300 0 1610737/40207104 10023263/23454144 -497221/6204800 10023263/23454144 1610737/40207104
        -4251941/54970650 3/20
    """),
    error_estimator_order=6,
    reference="Dormand, El-Mikkawy & Prince, IMA J. Numer. Anal. 7 (1987) 423, table 1, RKN8(6)9FM; "
    "corrigendum: IMA J. Numer. Anal. 11 (1991) 297",
)
# The paper offers these numbers on request only. Some of the longest integers are truncated in the available copies:
# with ...125 as the last digits of the numerator of A[13, 5] the conditions on that row hold exactly. All order
# conditions hold to 2e-54.
RKN1210 = _Published(
    "RKN1210",
    [
        [],
        ["1/5000"],
        ["1/3750", "1/1875"],
        ["7/2400", "-1/240", "1/160"],
        ["2/1215", 0, "4/729", "32/18225"],
        ["152/78125", 0, "1408/196875", "2048/703125", "432/546875"],
        ["29/51200", 0, "341/387072", "-151/345600", "243/716800", "-11/110592"],
        ["37/12000", 0, 0, "2/1125", "27/10000", "5/3168", "224/20625"],
        _fractions("""
            100467472123373/27511470744477696 0 101066550784375/25488568483854336 49478218404275/15475202293768704
            21990175014231/2674726322379776 -3576386017671875/2723635603703291904 16163228153/1654104722787
            38747524076705/10316801529179136
        """),
        _fractions("""
            62178936641284701329/16772293867250014666848 0 46108564356250/9072835168325103
            1522561724950/1296119309760729 -45978886013453735443/2174186242050927827184
            299403512366617849203125/4981371278573254356053856 15571226634087127616/774466927638876610083
            -133736375367792139885/4717207650164066625051 7461389216/501451974639
        """),
        _fractions("""
            501256914705531962342417557181/14270506505142656332600844507392 0 -1143766215625/132752960853408
            -6864570325/1185294293334 194348369382310456605879163404183/99893545535998594328205911551744
            -94634958447010580589908066176109375/27549212808177898050085930321520256
            -17006472665356285286219618514/155584463413110817059022733377
            33530528814694461893884349656345/14270506505142656332600844507392 -13439782155791134368/17777268379678341919
            1441341768767571/13159456712985856
        """),
        _fractions("""
            105854110734231079069010159870911189747853/5156624149476760916008179453333467046288864 0
            -144579793509250000/19842290513127000261 -101935644099967250/48188419817594143491
            1585474394319811696785932424388196965/1709257457318830856936350991091849456
            -843499776333774172853009613469456309715703125/510505790798199330684809765880013237582597536
            -15057703799298260121553794369056896088480/714327132646734138085088291809720015274157
            1749840442221344572962864758990584360232600/1450300542040339007627300471250037606768743
            -11255775246405733991656178432768/27206626483067760480757659602193 669010348769579696/7368057640845834597
            4598083098752/858563707934367
        """),
        _fractions("""
            -1639758773684715326849438048667467886824967397/11447568726280607813664651120965112496134881280 0
            3942453384375/314673684985856 11737114158175/1719466921529856
            -23710715033675876683332701739887457/4940189888325748664958546898558976
            498150575499633273684774666731162498301909124515625/87415924307623977386706008889913792042985180430336
            64881557768202140428371179540010005713998551/85896810580242200654071863296887242202224768
            -2336309182318568698279006266321563486172654055/18316109962048972501863441793544179993815810048
            -493399374030747471036018890494175/251658285736841065236836942273664
            418285003077108927126515545155/455369916679568501838710898688 -15171723902781457/63532954684873728
            1501203688494867/9434957026426880
        """),
        _fractions("""
            34188549803371802849576690267872548602326398788953/42496542183406636759747616530102745233754251202880 0
            -18971246281693750/1138830954584356089 -59230464334542700/2765732318276293359
            5147939981309774383134903239728881770043/305929030949718561059100251282184099064
            -3625720213550267723370658302114678215563058405229078120/
            324512095420929759624784749347170583153994213035432256
            -60305503318319653518547439098565661266182518307816/17856872599361492097414471889911176856851308259643
            -1036461878759982363277481306266144563833492657780645/67994467493450618815596186448164392374006801924608
            128398681100219349205889126776607047000/7473801441221286756994805323613917077
            -49156374556350058671822606102117/9039888303968618912866414995904 12253036339964386945/8828680926314891943
            -647188390508758231059/1092148506009694282240 10915833599872/368729913707897
        """),
        _fractions("""
            -4939337286263213195547765488387521892799075623007291241961609516532/
            5408250052307451520718178852915698257207815452080611897685945761264 0
            7588799849596321243074032368290625/3147217749590114939838670370597819616
            16870665568420512953501332587233725/955405388268427749593882076788623812
            -808642515918378014850308582271476014669568437579087796060/
            54447992506702009927986632715967769032585338753056786562
            4610328329649866588704236006423149172472141907645890762410296050212/
            2135428689710103309390449198881479603148467934048051598947383737508
            4159963831215576225909381034291748993887819834160487158570788681/
            1040533184037697645660563795162185415624171583014576682740416336
            7381392142124351279433801934148706553542137071890521365664606664449580/
            259596002510757672994472584939953516345975141699869371088925396540699
            -3336834334584052813468828675971359774694437229547862706920/
            132102862435303266640535426836147775872819092781208127980
            426619379967412086875039012957475466130081426048213491790/
            55162410119399855550108207148248549410926885937244965785
            -630755628691078947314733435975762542732598947/333503232300511886435069380727586592765317456
            1522350657470125698997653827133798314909646891/1520094067152619944607524353149267399623188480
            305575414262755427083262606101825880/65839748482572312891297405431209259829
            256624643108055110568255672032710477795/22874609758516552135947898572671559986304
        """),
        _fractions("""
            -571597862947184314270186718640978947715678864684269066846/
            2077055064880303907616135969012720011907767004397744786340 0 66981514290625/1829501741761029
            43495576635800/4443075658562499 -127865248353371207265315478623656127/10401415428935853634424440540325344
            1316565142658075739557231574080234814338066993483960326560/
            92668695535091962564795912774190176478892159517481612467
            3881494143728609118531066904799685950051960514138645179820/
            2446349095978358868919950548516272963929118212742344026549
            162922667049680755852592453758428194006198229544701786842910/
            66288722243155885736983218667976563740242178853010092663614
            -43986024977384568043684084266385512680544563954/4922783599524658241955780540171948284522386185
            285912200202585226675651763671663063668290787/65371192072964016939690070594254881767827200
            -6776815256667778089672518929/3693654613173093729492918708
            398946554885847045598775476868169/344154261237450078839899047372800 -76630698033396272/4432017119727044925
            28401702316003037/1469612686944417840
            66049942462586341419969330578128801/12691068622536592094919763114637498325
        """),
        _fractions("""
            83940754497395557520874219603241359529066454343054832302344735/
            64192596456995578553872477759926464976144474354415663868673233 0
            892543892035485503125/51401651664490002607536 -12732238157949399705325/686579204375687891972088
            5290376174838819557032232941734928484252549/357179779572898187570048915214361602000384
            26873229338017506937199991804717456666650215387938173031932210/
            2863980005760296740624015421425947092438943496681472214589916
            -1976497866818803305857417297961598735637414137241493515492778650/
            378029217824623393200881653405474359138017953416246216408422692
            -1002860756304839757040188283199900676042073362417943601440986856950/
            20486915674765670626893195919603679319429068544972409068469849579
            87398661196965758104117684348440686081062878816711392590/
            2282122412587168891929052689609009868137678763277087160
            -7922242431969626895355493632206885458496418610471389/748272134517487495468365669337985635214015258726400
            2777643183645212014464950387658055285/1141545470045611737197667093465955392
            -1372659703515496442825084239977218110461/1313121960368535725613950174847107891200
            6144417902699179309851023/85608793932459282773805825 140294243355138853053241/64884622846351585391642880
            168671028523891369934964082754523881107337/24062875279623260368388427013982199424119600
        """),
    ],
    _fractions("""
        63818747/5262156900 0 0 0 0 0 22555300000000/261366897038247 1696514453125/6717619827072 -45359872/229764843
        19174962087/94371046000 -19310468/929468925 16089185487681/146694672924800 1592709632/41841694125
        52675701958271/4527711056573100 12540904472870916741199505796420811396/2692319557780977037279406889319526430375
        0 0
    """),
    _fractions("""
        63818747/5262156900 0 0 0 0 0 451106000000000/4965971043726693 8482572265625/26870479308288 -181439488/689294529
        57524886261/188742092000 -38620936/929468925 144802669389129/586778691699200 6370838528/41841694125
        368729913707897/4527711056573100
        111940113324845802831946788738852162520696/1316544263754897771229629968877248424453375 -113178587/12362232960
        1/40
    """),
    _fractions("""
        0 1/50 1/25 1/10 2/15 4/25 1/20 1/5 1/4 1/3 1/2 5/9 3/4 6/7 8437/8926 1 1
    """),
    order=12,
    b_hat=_fractions("""
        27121957/1594593000 0 0 0 0 0 4006163300000/55441463008113 9466403125/25445529648 -163199648/406149975
        23359833/69636250 -18491714/140828625 11052304606701/58344472186000 1191129152/44377554375
        2033811086741/124730332137000 3616943474975740389660406409450169802/951830146690244407118982233597812374375 0 0
    """),
    b_prime_hat=_fractions("""
        27121957/1594593000 0 0 0 0 0 4217014000000/55441463008113 47332015625/101782118592 -652798592/1218449925
        70079499/139272500 -36983428/140828625 99470741460309/233377888744000 4764516608/44377554375
        14236677607187/124730332137000 198066487470143918516004831967805004004/2855490440070733221356946700793437123125
        1/50 0
    """),
    error_estimator_order=10,
    reference="Dormand, El-Mikkawy & Prince, IMA J. Numer. Anal. 7 (1987) 423, RKN12(10), 17 stages; fractions: "
    "Brankin, Gladwell, Dormand, Prince & Seward, ACM Trans. Math. Softw. 15 (1989) 31 (Algorithm 670)",
)
