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

/* a plus what column 0 gets from its opposite point p: (re + i im) conj(p). */
INLINE cvec add_edge(const cvec a, const real re, const real im, const scalar p)
{
    return (cvec){
        a.re + FIRST_LANE * (re * p.re + im * p.im), a.im + FIRST_LANE * (im * p.re - re * p.im)
    };
}

/* otfs_image = FFT(spectra_0) / (4 NX NY) along the columns, made from the row spectra of a PSF:
 * 1 / (NX NY) for the inverse transforms, 1 / 4 for the two factors 2 that rfft_rows leaves. Column 0 and
 * otf_edges get (K_A + K_B) / 2 and (K_A - K_B) / 2.
 * spectra: N_SPECTRA arrays, const, of which array 0 is read. otfs: an array an image; that of `image`
 * is written, and its part of otf_edges, [..][NY][2]. steps[GOING] 0: nothing.
 * Launch: up to COLUMN_BLOCKS groups. Out of place. Scratch: NY points.
 * Twin: reference.otf_columns.
 */
KERNEL void otf_columns(
    __global vec *restrict otfs, __global real *restrict otf_edges,
    __global const vec *restrict spectra, __global const real *restrict steps, const int image,
    const int n_images, const int n_skies, __global const real *restrict column_roots,
    SCRATCH vec *restrict scratch)
{
    const real norm = (real)1 / 4 / NX / NY;
    LINES_IN(z, scratch, NY);
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], block, COLUMN_BLOCKS) {
        __global vec *k = otfs + (size_t)image * PIXELS_SIZE + (size_t)block * NY * 2 * SIDE;
        forward_columns(z, spectra + (size_t)block * ROWS * 2 * SIDE, NY, column_roots);
        show_column_0(z, NY, block);
        FOR_EACH_POINT(i, NY) {
            const int t = PLACE_OF(i, NY), lane = LANE_OF(i);
            cvec a = times(POINT(z, i), norm);
            if (block == 0 && lane == 0) {
                const scalar p = OWN_OF_COLUMN_0(z, i, t), q = OPPOSITE(z, i, t, 1);
                const real a_re = p.re + q.re, a_im = p.im - q.im;
                const real b_re = p.im + q.im, b_im = q.re - p.re;
                a.re = (1 - FIRST_LANE) * a.re + FIRST_LANE * ((a_re + b_re) * norm / 4);
                a.im = (1 - FIRST_LANE) * a.im + FIRST_LANE * ((a_im + b_im) * norm / 4);
                otf_edges[2 * (image * NY + t)] = (a_re - b_re) * norm / 4;
                otf_edges[2 * (image * NY + t) + 1] = (a_im - b_im) * norm / 4;
            }
            SET_OTF_POINT(k, i, t, a);
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

/* Point i of an image's columns, in reversed order: the sum of OVERSAMPLE points of otfs_j FFT(f).
 * `k` and `edge` are those of image and block; `edges` tells whether this is column 0.
 */
INLINE cvec convolved(
    const HELD_LINES source, __global const vec *k, __global const real *edge, const int i,
    const bool edges)
{
    cvec total;
    UNROLL
    for (int q = 0; q < OVERSAMPLE; ++q) {
        const int place = PLACE_OF(i, IMAGE_NY) * OVERSAMPLE + q;
        cvec a = multiply(POINT_OF_SKY(source, i, q), OTF_POINT(k, i, q, OVERSAMPLE, place));
        if (edges) {
            const int at = i * OVERSAMPLE + q;
            a = add_edge(a, edge[2 * place], edge[2 * place + 1], OPPOSITE_HELD(source, at, place));
        }
        total = q > 0 ? add(total, a) : a;
    }
    return total;
}

/* Columns of one of several skies, transformed, to its array and from there, in the order of OTFs. */
INLINE void put_sky(__global vec *sky, const LINES lines)
{
    FOR_EACH_POINT(i, NY) {
        const cvec a = POINT(lines, i);
        SET_OTF_POINT(sky, i, PLACE_OF(i, NY), a);
    }
    BARRIER;
}

INLINE void take_sky(LINES lines, __global const vec *sky)
{
    FOR_EACH_POINT(i, NY) {
        const cvec a = OTF_POINT(sky, i, 0, 1, PLACE_OF(i, NY));
        SET_POINT(lines, i, a);
    }
    BARRIER;
}

/* sky <- mix lines, or sky + mix lines where has_begun. */
INLINE void add_to_sky(
    __global vec *sky, const HELD_LINES lines, const real mix, const bool has_begun)
{
    FOR_EACH_POINT(i, NY) {
        const int place = PLACE_OF(i, NY);
        cvec a = times(POINT(lines, i), mix);
        if (has_begun)
            a = add(a, OTF_POINT(sky, i, 0, 1, place));
        SET_OTF_POINT(sky, i, place, a);
    }
}

/* sum_k mixes_k of the skies, in the order in which it may lie in the array of the last. */
INLINE void mix_skies(
    HELD_LINES mixed, __global const vec *skies, __global const real *mixes, const int n_skies)
{
    bool is_first = true;
    for (int k = n_skies - 1; k >= 0; --k) {
        __global const vec *sky = skies + (size_t)k * SPECTRA_SIZE;
        if (mixes[k] == 0)
            continue;
        FOR_EACH_POINT(i, NY) {
            cvec a = times(OTF_POINT(sky, i, 0, 1, PLACE_OF(i, NY)), mixes[k]);
            if (!is_first)
                a = add(a, POINT(mixed, i));
            SET_POINT(mixed, i, a);
        }
        is_first = false;
    }
    BARRIER;
}

/* spectra_j <- IFFT(otfs_j sum_k mixes_jk FFT(skies_k)) along the columns: the row spectra of A_j of the
 * skies that image j sees, in every OVERSAMPLE-th row, from the skies' own; mixes count as 1 where there
 * is one sky. With a transmission (transmit.cl) each image has its own sky, FFT(spectra_j). The FFT of a
 * sky may be held in its array, and image 0, which has that of the last, is made last.
 * spectra: N_SPECTRA arrays, those of the skies and of the images, written but for their padding. mixes:
 * [n_images][n_skies]. otfs: n_images arrays, const; otf_edges: [n_images][NY][2]. row_phases
 * (HAS_TURNS), by which rows are multiplied then:
 * [n_images][COLUMN_BLOCKS][NY / PHASE_ROWS + PHASE_ROWS][2][BLOCK]. steps[GOING] 0: nothing.
 * Launch: up to COLUMN_BLOCKS groups; with a transmission so many an image. In place.
 * Scratch: SCRATCH_POINTS. Twin: reference.convolve_columns.
 */
KERNEL void convolve_columns(
    __global vec *restrict spectra, __global const vec *restrict otfs,
    __global const real *restrict otf_edges, __global const vec *restrict row_phases,
    __global const real *restrict mixes, __global const real *restrict steps, const int n_images,
    const int n_skies, const int has_transmission, __global const real *restrict column_roots,
    __global const real *restrict image_column_roots, SCRATCH vec *restrict scratch)
{
    const int n_own = has_transmission ? 1 : n_images; /* images of the same skies */
    const int n_mixed = has_transmission ? 1 : n_skies;
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], unit, COLUMN_BLOCKS * (n_images / n_own)) {
        const int block = unit % COLUMN_BLOCKS, first = unit / COLUMN_BLOCKS;
        const size_t skies = has_transmission ? IMAGE_SPECTRA(first, n_skies) : 0;
        __global vec *columns = spectra + skies + (size_t)block * ROWS * 2 * SIDE;
        LINES_AND_HELD(z, held, scratch, columns);
        for (int k = 0; k < n_mixed; ++k) {
            __global vec *sky = columns + (size_t)k * SPECTRA_SIZE;
            forward_columns(FIRST_HELD(z, held), sky, NY, column_roots);
            if (n_mixed > 1)
                put_sky(sky, FIRST_HELD(z, held));
        }
        if (n_mixed == 1)
            HOLD(held, z);
        for (int own = n_own - 1; own >= 0; --own) {
            const int image = first + own;
            __global vec *to = columns + IMAGE_SPECTRA(own, n_mixed);
            HELD_LINES seen = HELD_OR(held, n_mixed > 1 ? to : held);
            if (n_mixed > 1)
                mix_skies(seen, columns, mixes + image * n_skies, n_skies);
            __global const vec *k =
                otfs + (size_t)image * PIXELS_SIZE + (size_t)block * NY * 2 * SIDE;
            __global const real *edge = otf_edges + 2 * image * NY;
            show_column_0(seen, NY, block);
            FOR_EACH_POINT(i, IMAGE_NY)
                SET_POINT(z, i, convolved(seen, k, edge, i, block == 0 && LANE_OF(i) == 0));
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

/* skies_k <- IFFT(sum_j mixes_jk conj(otfs_j) FFT(spectra_j)) along the columns: the row spectra of
 * sum_j mixes_jk A_j^T (r_j - w_j) from those of the r_j - w_j. With a transmission
 * spectra_j <- IFFT(conj(otfs_j) FFT(spectra_j)). Arguments as in convolve_columns; the arrays of skies
 * are written, and with several skies those of images may be. steps[FRESH] 0: nothing.
 * Launch: up to COLUMN_BLOCKS groups; with a transmission so many an image. In place.
 * Scratch: SCRATCH_POINTS. Twin: reference.correlate_columns.
 */
KERNEL void correlate_columns(
    __global vec *restrict spectra, __global const vec *restrict otfs,
    __global const real *restrict otf_edges, __global const vec *restrict row_phases,
    __global const real *restrict mixes, __global const real *restrict steps, const int n_images,
    const int n_skies, const int has_transmission, __global const real *restrict column_roots,
    __global const real *restrict image_column_roots, SCRATCH vec *restrict scratch)
{
    const int n_own = has_transmission ? 1 : n_images; /* images of the same skies */
    const int n_mixed = has_transmission ? 1 : n_skies;
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[FRESH], unit, COLUMN_BLOCKS * (n_images / n_own)) {
        const int block = unit % COLUMN_BLOCKS, first = unit / COLUMN_BLOCKS;
        const size_t skies = has_transmission ? IMAGE_SPECTRA(first, n_skies) : 0;
        __global vec *columns = spectra + skies + (size_t)block * ROWS * 2 * SIDE;
        LINES_AND_HELD(z, held, scratch, columns);
        for (int own = 0; own < n_own; ++own) {
            const int image = first + own;
            __global const vec *from = columns + IMAGE_SPECTRA(own, n_mixed);
            __global const vec *otf =
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
            show_column_0(z, IMAGE_NY, block);
            HELD_LINES seen =
                HELD_OR(held, n_mixed > 1 ? columns + IMAGE_SPECTRA(own, n_mixed) : held);
            FOR_EACH_POINT(i, NY) {
                const int place = PLACE_OF(i, NY);
                cvec product =
                    multiply_conjugate(POINT_OF_IMAGE(z, i), OTF_POINT(otf, i, 0, 1, place));
                if (block == 0 && LANE_OF(i) == 0) {
                    __global const real *edge = otf_edges + 2 * (image * NY + place);
                    product =
                        add_edge(product, edge[0], -edge[1], OPPOSITE(z, i, place, OVERSAMPLE));
                }
                if (own > 0 && n_mixed == 1)
                    product = add(product, POINT(held, i));
                SET_POINT(seen, i, product);
            }
            /* A pass of its own, which takes fewer registers. The last sky may share the image's array. */
            for (int k = 0; k < (n_mixed > 1 ? n_mixed : 0); ++k) {
                const real mix = mixes[image * n_skies + k];
                if (mix != 0 || own == 0)
                    add_to_sky(columns + (size_t)k * SPECTRA_SIZE, seen, mix, own > 0);
            }
            BARRIER;
        }
        if (n_mixed == 1)
            TAKE_HELD(z, held);
        LINES sum = FIRST_HELD(z, held);
        for (int k = 0; k < n_mixed; ++k) {
            __global vec *sky = columns + (size_t)k * SPECTRA_SIZE;
            if (n_mixed > 1)
                take_sky(sum, sky);
            dit_inner(sum, NY, column_roots);
            finish_columns(sky, sum, NY, column_roots);
        }
    }
}
