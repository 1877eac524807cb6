/* Products with OTFs, inside the transforms along the columns of half spectra.
 *
 * Column 0 carries two Hermitian spectra, A (k_x = 0) and B (k_x = Nx / 2), as P = A + i B. Its
 * product with the two OTFs K_A and K_B needs the opposite point too:
 *     K_A A + i K_B B = (K_A + K_B) / 2 P(k) + (K_A - K_B) / 2 conj(P(-k)).
 * The first factor is kept in column 0 of the OTF, the second in `otf_edges`, [NY][2] reals an
 * image.
 *
 * Where the sky is finer than the images, an image has every OVERSAMPLE-th point of the convolved
 * sky. Its spectrum is periodic: frequency k holds the sum of k, k + IMAGE_NY, k + 2 IMAGE_NY ...,
 * which are neighbours in reversed order. Here columns are folded so; ratio.cl folds the rows.
 */

/* What a column block holds while it goes through the images lies in the scratch where that has room
 * for two blocks, else in array 0 of the spectra; `z` is the block that is transformed.
 */
#if SCRATCH_BLOCKS > 1
#define HELD SCRATCH
#define SCRATCH_POINTS (NY + IMAGE_NY)
#define SCRATCH_OF(scratch, columns)                       \
    HELD vec *held = OWN_SCRATCH(scratch, SCRATCH_POINTS); \
    SCRATCH vec *z = held + 2 * NY * SIDE
#else
#define HELD __global
#define SCRATCH_POINTS NY
#define SCRATCH_OF(scratch, columns) \
    HELD vec *held = columns;        \
    SCRATCH vec *z = OWN_SCRATCH(scratch, SCRATCH_POINTS)
#endif

/* Where the opposite of point t of column 0 begins, in reals; one point stands for `share` points. */
#define OPPOSITE(t, share) (2 * (opposite_place(t, NY) / (share)) * BLOCK)

/* a plus what column 0 gets from its opposite point p: (re + i im) conj(p). */
INLINE cvec add_edge(const cvec a, const real re, const real im, const real p_re, const real p_im)
{
    return (cvec){
        a.re + FIRST_LANE * (re * p_re + im * p_im), a.im + FIRST_LANE * (im * p_re - re * p_im)
    };
}

/* otfs_image = FFT(spectra) / (4 NX NY) along the columns, made from the row spectra of a PSF: 1 / (NX NY)
 * for the inverse transforms, 1 / 4 for the two factors 2 that rfft_rows leaves. Column 0 and
 * otf_edges get (K_A + K_B) / 2 and (K_A - K_B) / 2.
 * spectra: n_images arrays, const, of which array 0 is read. otfs: an array an image; that of `image`
 * is written, and its part of otf_edges, [..][NY][2]. steps[GOING] 0: nothing.
 * Launch: up to COLUMN_BLOCKS groups. Out of place. Scratch: NY points.
 * Twin: reference.otf_columns.
 */
KERNEL void otf_columns(
    __global vec *restrict otfs, __global real *restrict otf_edges,
    __global const vec *restrict spectra, __global const real *restrict steps, const int image,
    const int n_images, __global const real *restrict column_roots, SCRATCH vec *restrict scratch)
{
    const real norm = (real)1 / 4 / NX / NY;
    SCRATCH vec *z = OWN_SCRATCH(scratch, NY);
    OF_MEMBER(spectra, (size_t)n_images * SPECTRA_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], block, COLUMN_BLOCKS) {
        __global vec *k = otfs + (size_t)image * PIXELS_SIZE + (size_t)block * NY * 2 * SIDE;
        forward_columns(z, spectra + (size_t)block * ROWS * 2 * SIDE, NY, column_roots);
        FOR_EACH(i, NY * 2 * SIDE)
            k[i] = z[i] * norm;
        BARRIER;
        if (block == 0) {
            FOR_EACH(t, NY) {
                SCRATCH const real *p = (SCRATCH const real *)z + 2 * t * BLOCK;
                SCRATCH const real *q = (SCRATCH const real *)z + OPPOSITE(t, 1);
                const real a_re = p[0] + q[0], a_im = p[BLOCK] - q[BLOCK];
                const real b_re = p[BLOCK] + q[BLOCK], b_im = q[0] - p[0];
                __global real *column_0 = (__global real *)k + 2 * t * BLOCK;
                column_0[0] = (a_re + b_re) * norm / 4;
                column_0[BLOCK] = (a_im + b_im) * norm / 4;
                otf_edges[2 * (image * NY + t)] = (a_re - b_re) * norm / 4;
                otf_edges[2 * (image * NY + t) + 1] = (a_im - b_im) * norm / 4;
            }
        }
        BARRIER;
    }
}

#if HAS_TURNS
/* Row y of the block of columns times its phase, sign 1, or that of the way back, -1: the first shear
 * of an image that is turned. `phases` are those of image and block: of the first of PHASE_ROWS rows
 * each, and then of a row among them. Columns 0 and NX / 2 are real, and share column 0: the first
 * stays, the other is multiplied by a cosine.
 */
INLINE cvec shifted(
    const cvec a, __global const vec *phases, const int y, const bool edges, const int sign)
{
    const cvec phase =
        multiply(LOAD(phases, y / PHASE_ROWS), LOAD(phases, NY / PHASE_ROWS + y % PHASE_ROWS));
    cvec b = sign > 0 ? multiply(a, phase) : multiply_conjugate(a, phase);
    if (edges) {
        b.re += FIRST_LANE * (a.re - b.re);
        b.im += FIRST_LANE * (a.im * phase.re - b.im);
    }
    return b;
}
#define PHASES_OF(phases, image, block)               \
    ((phases)                                         \
        + ((size_t)(image) * COLUMN_BLOCKS + (block)) \
            * ((NY / PHASE_ROWS + PHASE_ROWS) * 2 * SIDE))
#endif

/* Point t of a column of an image, in reversed order: the sum of OVERSAMPLE points of otfs_j FFT(f).
 * `k` and `edge` are those of image and block; `edges` tells whether this is column 0.
 */
INLINE cvec convolved(
    HELD const vec *source, __global const vec *k, __global const real *edge, const int t,
    const int lane, const bool edges)
{
    cvec total;
    UNROLL
    for (int q = 0; q < OVERSAMPLE; ++q) {
        const int point = t * OVERSAMPLE + q;
        cvec a = multiply(LOAD(source + lane, point), LOAD(k + lane, point));
        if (edges) {
            HELD const real *opposite = (HELD const real *)source + OPPOSITE(point, 1);
            a = add_edge(a, edge[2 * point], edge[2 * point + 1], opposite[0], opposite[BLOCK]);
        }
        total = q > 0 ? add(total, a) : a;
    }
    return total;
}

/* spectra_j <- IFFT(otfs_j FFT(spectra_0)) along the columns: the row spectra of A_j f from f's, in
 * every OVERSAMPLE-th row. Where each image has a sky of its own (has_skies, see transmit.cl) it is
 * FFT(spectra_j). The FFT of a sky may be held in its array, which is made last.
 * spectra: n_images arrays, written but for their padding. otfs: n_images arrays, const;
 * otf_edges: [n_images][NY][2]. row_phases (HAS_TURNS), by which rows are multiplied then:
 * [n_images][COLUMN_BLOCKS][NY / PHASE_ROWS + PHASE_ROWS][2][BLOCK]. steps[GOING] 0: nothing.
 * Launch: up to COLUMN_BLOCKS groups a sky. In place. Scratch: SCRATCH_POINTS.
 * Twin: reference.convolve_columns.
 */
KERNEL void convolve_columns(
    __global vec *restrict spectra, __global const vec *restrict otfs,
    __global const real *restrict otf_edges, __global const vec *restrict row_phases,
    __global const real *restrict steps, const int n_images, const int has_skies,
    __global const real *restrict column_roots, __global const real *restrict image_column_roots,
    SCRATCH vec *restrict scratch)
{
    const int n_own = has_skies ? 1 : n_images; /* images of one sky */
    OF_MEMBER(spectra, (size_t)n_images * SPECTRA_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], unit, COLUMN_BLOCKS * (n_images / n_own)) {
        const int block = unit % COLUMN_BLOCKS, sky = unit / COLUMN_BLOCKS;
        __global vec *columns =
            spectra + (size_t)sky * SPECTRA_SIZE + (size_t)block * ROWS * 2 * SIDE;
        SCRATCH_OF(scratch, columns);
#if SCRATCH_BLOCKS > 1
        forward_columns(held, columns, NY, column_roots);
#else
        forward_columns(z, columns, NY, column_roots);
        FOR_EACH(i, NY * 2 * SIDE)
            held[i] = z[i];
        BARRIER;
#endif
        for (int own = n_own - 1; own >= 0; --own) {
            const int image = sky + own;
            __global vec *to = columns + (size_t)own * SPECTRA_SIZE;
            __global const vec *k =
                otfs + (size_t)image * PIXELS_SIZE + (size_t)block * NY * 2 * SIDE;
            __global const real *edge = otf_edges + 2 * image * NY;
            FOR_EACH(piece, IMAGE_NY * SIDE) {
                const int t = piece / SIDE, lane = piece % SIDE;
                STORE(z + lane, t, convolved(held, k, edge, t, lane, block == 0 && lane == 0));
            }
            BARRIER;
            dit_inner(z, IMAGE_NY, image_column_roots);
#if HAS_TURNS
            __global const vec *phases = PHASES_OF(row_phases, image, block);
            finish_rows(z, NY, column_roots);
            FOR_EACH(piece, NY * SIDE) {
                const int y = piece / SIDE, lane = piece % SIDE;
                const cvec a = LOAD(z + lane, y);
                STORE(to + lane, y, shifted(a, phases + lane, y, block == 0 && lane == 0, 1));
            }
            BARRIER;
#else
            finish_columns(to, z, IMAGE_NY, image_column_roots);
#endif
        }
    }
}

/* spectra_0 <- IFFT(sum_j conj(otfs_j) FFT(spectra_j)) along the columns: the row spectrum of
 * sum_j A_j^T (r_j - w_j) from those of the r_j - w_j. Where each image has a sky of its own
 * (has_skies) spectra_j <- IFFT(conj(otfs_j) FFT(spectra_j)). Shapes as in convolve_columns; the
 * arrays of skies alone are written. steps[FRESH] 0: nothing.
 * Launch: up to COLUMN_BLOCKS groups a sky. In place. Scratch: SCRATCH_POINTS.
 * Twin: reference.correlate_columns.
 */
KERNEL void correlate_columns(
    __global vec *restrict spectra, __global const vec *restrict otfs,
    __global const real *restrict otf_edges, __global const vec *restrict row_phases,
    __global const real *restrict steps, const int n_images, const int has_skies,
    __global const real *restrict column_roots, __global const real *restrict image_column_roots,
    SCRATCH vec *restrict scratch)
{
    const int n_own = has_skies ? 1 : n_images; /* images of one sky */
    OF_MEMBER(spectra, (size_t)n_images * SPECTRA_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[FRESH], unit, COLUMN_BLOCKS * (n_images / n_own)) {
        const int block = unit % COLUMN_BLOCKS, sky = unit / COLUMN_BLOCKS;
        __global vec *columns =
            spectra + (size_t)sky * SPECTRA_SIZE + (size_t)block * ROWS * 2 * SIDE;
        SCRATCH_OF(scratch, columns);
        for (int own = 0; own < n_own; ++own) {
            const int image = sky + own;
            __global const vec *from = columns + (size_t)own * SPECTRA_SIZE;
            __global const vec *k =
                otfs + (size_t)image * PIXELS_SIZE + (size_t)block * NY * 2 * SIDE;
#if HAS_TURNS
            __global const vec *phases = PHASES_OF(row_phases, image, block);
            FOR_EACH(piece, NY * SIDE) {
                const int y = piece / SIDE, lane = piece % SIDE;
                const cvec a = LOAD(from + lane, y);
                STORE(z + lane, y, shifted(a, phases + lane, y, block == 0 && lane == 0, -1));
            }
            BARRIER;
            begin_rows(z, NY, column_roots);
            dif_inner(z, NY, column_roots);
#else
            forward_columns(z, from, IMAGE_NY, image_column_roots);
#endif
            FOR_EACH(piece, NY * SIDE) {
                const int t = piece / SIDE, lane = piece % SIDE;
                const cvec a = LOAD(z + lane, t / OVERSAMPLE);
                cvec product = multiply_conjugate(a, LOAD(k + lane, t));
                if (block == 0 && lane == 0) {
                    __global const real *edge = otf_edges + 2 * (image * NY + t);
                    SCRATCH const real *opposite =
                        (SCRATCH const real *)z + OPPOSITE(t, OVERSAMPLE);
                    product = add_edge(product, edge[0], -edge[1], opposite[0], opposite[BLOCK]);
                }
                if (own > 0)
                    product = add(product, LOAD(held + lane, t));
                STORE(held + lane, t, product);
            }
            BARRIER;
        }
#if SCRATCH_BLOCKS > 1
        z = held;
#else
        FOR_EACH(i, NY * 2 * SIDE)
            z[i] = held[i];
        BARRIER;
#endif
        dit_inner(z, NY, column_roots);
        finish_columns(columns, z, NY, column_roots);
    }
}
