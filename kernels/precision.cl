/* The one header for precision, and for what the host fixes when it builds.
 *
 * Constants given by the host (lnocl/core/opencl/program.py):
 *   REAL, BITS      float and int, or double and long
 *   LANES           reals in a vector: 16, 8, 4, 2 or 1
 *   BLOCK           columns, or pairs of rows, transformed together; a multiple of LANES
 *   GROUP           work-items that share a block, a power of two
 *   ROW_ODD, ROW_OUTER, ROW_LAST, COLUMN_ODD, COLUMN_OUTER, COLUMN_LAST
 *                   odd factor of an axis, and radices of its transform, see fft.cl
 *   IMAGE_ROW_OUTER, IMAGE_ROW_LAST, IMAGE_COLUMN_OUTER, IMAGE_COLUMN_LAST
 *                   the same of the images' axes, whose odd factors are those of the sky's
 *   IN_REGISTERS    0 or 1: whether work-items hold the lines that they transform: registers.cl, else
 *                   scratch.cl
 *   CHUNK           points of a transform that are finished before the next are begun
 *   SCRATCH_IS_GLOBAL   0 or 1: where a block lies while it is transformed
 *   SCRATCH_BLOCKS  1 or 2: blocks of columns that the scratch has room for
 *   HAS_BUILTIN_PREFETCH   0 or 1: whether the compiler is known to take __builtin_prefetch
 *   NX, NY          the grid of the sky, each 1, 3, 5, 7 or 9 times a power of two, up to 8192
 *   OVERSAMPLE      pixels of the sky to one of the images, along each axis: 1, 2 or 4; 2 BLOCK
 *                   OVERSAMPLE divides that power of two
 *   ROWS            rows that a block of spectra takes in memory: NY and some padding
 *   HAS_TURNS       0 or 1: whether images are turned against the sky; then OVERSAMPLE is 1
 *   TURN_TAPS, PHASE_ROWS, COLUMN_PAIRS   weights of a shift, rows between those whose phases are
 *                   tabled, and pairs of rows in a piece of a column, see turn.cl
 *   MIN_MODEL     the division guard
 *
 * Layouts, in reals, the last index fastest:
 *   pixels    [NY / 2 / BLOCK][NX][2][BLOCK]     lanes are pairs of rows: 2 y and 2 y + 1
 *             of the sky; those of an image have IMAGE_NY and IMAGE_NX
 *   spectra   [NX / 2 / BLOCK][ROWS][2][BLOCK]   lanes are columns; real part, imaginary part;
 *             of an image IMAGE_NY of the rows are used
 *   otf       [NX / 2 / BLOCK][NY][2][BLOCK]     as spectra, or in the order of registers.cl
 * A block of BLOCK reals is SIDE vectors of LANES reals.
 */

#define PASTE_(a, b) a##b
#define PASTE(a, b) PASTE_(a, b)

#if LANES == 1
#define WIDTH
#define FIRST_LANE ((vec)1)
#else
#define WIDTH LANES
#if LANES == 2
#define FIRST_LANE ((vec)(1, 0))
#elif LANES == 4
#define FIRST_LANE ((vec)(1, 0, 0, 0))
#elif LANES == 8
#define FIRST_LANE ((vec)(1, 0, 0, 0, 0, 0, 0, 0))
#else
#define FIRST_LANE ((vec)(1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
#endif
#endif

typedef REAL real;
typedef PASTE(REAL, WIDTH) vec;
typedef PASTE(BITS, WIDTH) ivec;
#define as_vec PASTE(as_, PASTE(REAL, WIDTH))
#define as_ivec PASTE(as_, PASTE(BITS, WIDTH))

#define SIDE (BLOCK / LANES)
#define IMAGE_NX (NX / OVERSAMPLE)
#define IMAGE_NY (NY / OVERSAMPLE)
#define ROW_BLOCKS (NY / 2 / BLOCK)
#define IMAGE_ROW_BLOCKS (IMAGE_NY / 2 / BLOCK)
#define COLUMN_BLOCKS (NX / 2 / BLOCK)
#define PIXELS_SIZE (NX * NY / LANES)                  /* vectors */
#define IMAGE_SIZE (IMAGE_NX * IMAGE_NY / LANES)       /* vectors */
#define SPECTRA_SIZE (COLUMN_BLOCKS * ROWS * 2 * SIDE) /* vectors */

/* Arrays of spectra: those of the skies, and from that of the last sky on those of the images. Image 0
 * is made last, and read first, so that it shares an array with a sky; with one sky it is array 0.
 */
#define N_SPECTRA(n_images, n_skies) ((size_t)((n_images) + (n_skies) - 1))
#define SPECTRA_OF_SKY(spectra, unit) ((spectra) + (size_t)((unit) / ROW_BLOCKS) * SPECTRA_SIZE)
#define IMAGE_SPECTRA(image, n_skies) ((size_t)((image) + (n_skies) - 1) * SPECTRA_SIZE)

/* Without it PoCL leaves calls behind, and registers go through memory. */
#define INLINE static inline __attribute__((always_inline))
/* For loops over registers: what is not unrolled early goes through memory. */
#define UNROLL _Pragma("unroll")
/* For rounds of work: unrolled, they take five times the registers of a GPU. */
#define ROLLED _Pragma("unroll 1")
/* For pixelwise work on an array of registers: unrolled, a CPU runs out of them and is slower; rolled,
 * a GPU takes the array for one in memory.
 */
#if GROUP > 1
#define UNROLL_IN_GROUPS UNROLL
#else
#define UNROLL_IN_GROUPS
#endif
#define KERNEL __kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
#if IN_REGISTERS /* that it is less than GROUP, a power of two, makes addresses constants there */
#define ITEM ((int)get_local_id(0) & (GROUP - 1))
#else
#define ITEM ((int)get_local_id(0))
#endif
#if GROUP > 1
#define BARRIER barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE)
#else
#define BARRIER
#endif

#if SCRATCH_IS_GLOBAL
#define SCRATCH __global
#define OWN_SCRATCH(scratch, points) \
    (scratch + (get_group_id(1) * get_num_groups(0) + get_group_id(0)) * (2 * SIDE * (points)))
#else
#define SCRATCH __local
#define OWN_SCRATCH(scratch, points) (scratch)
#endif

/* Asks for the cache line at p before it is needed. PoCL's prefetch() does nothing, and compilers
 * that go through SPIR-V end the process at the builtin.
 */
#if GROUP > 1
#define PREFETCH(p)
#elif HAS_BUILTIN_PREFETCH
#define PREFETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#else
#define PREFETCH(p) prefetch(p, 1)
#endif

/* The numbers that a run has on the device, of what its solver has decided: `steps`. */
enum {
    GOING,        /* whether it continues */
    FRESH,        /* whether this tick has a new estimate */
    RECORDED,     /* objectives recorded */
    TARGET,       /* as many end it for now */
    TOLERANCE,    /* the relative change an iteration at which it has settled */
    ROUNDING,     /* a rise of the objective, as a share of it, that may be rounding */
    REASON,       /* why it has ended: see decide.cl */
    ALPHA,        /* the last step */
    LENGTH,       /* the last Barzilai-Borwein step */
    IS_FIRST,     /* whether no step was made yet */
    SHARE,        /* the share of the step that is tried; 0 where none is, as at a start */
    SHORTENED,    /* how often it was shortened */
    SLOPE,        /* its slope */
    PRIOR_CHANGE, /* and the change of the term of the stars' prior */
    N_NUMBERS
};

/* Members of a batch share a scene, but for their images, the mean of their prior, and what an
 * iteration makes: of these each has its own, one behind the other. This moves p, of which a member has
 * `size`, to the part of the member that this group works for. Launches have members along axis 1.
 */
#define OF_MEMBER(p, size) ((p) += get_group_id(1) * (size))

/* Shares n blocks among however many work-groups were launched. Where lines lie in registers these are
 * n: addresses that hold for every round of a loop would take registers too.
 */
#if IN_REGISTERS
#define FOR_EACH_BLOCK(block, n) \
    for (int block = get_group_id(0), is_due_ = 1; is_due_ && block < (n); is_due_ = 0)
#else
#define FOR_EACH_BLOCK(block, n) \
    for (int block = get_group_id(0); block < (n); block += get_num_groups(0))
#endif

/* The same, but nothing where a number of a run is 0: so a tick is a branch where it has ended. */
#define FOR_EACH_BLOCK_IF(number, block, n) FOR_EACH_BLOCK(block, (number) != 0 ? (n) : 0)

/* Shares n pieces of work among the work-items of a group. All items do the same number of rounds:
 * PoCL 3 miscompiles loops round barriers whose bounds differ between the items.
 */
#if GROUP > 1
#define FOR_EACH(piece, n)                                                        \
    ROLLED for (int round_ = 0, piece = ITEM; round_ < ((n) + GROUP - 1) / GROUP; \
        ++round_, piece += GROUP) if (piece < (n))
#else
#define FOR_EACH(piece, n) for (int piece = 0; piece < (n); ++piece)
#endif
