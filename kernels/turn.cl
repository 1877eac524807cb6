/* Images that are turned against the sky: three shears, the first along x, the second along y, the
 * third along x again (lnocl/core/scene/rotation.py). convolve.cl does the first, as phases of the rows.
 * Here the others shift lines by TURN_TAPS weights each.
 *
 * Between the kernels the pixels of one image lie so that a shift along y is a shift in memory:
 * [PIECES][NX][2][PIECE] reals, in pieces of the columns. A piece has COLUMN_PAIRS pairs of rows, the
 * even ones and then the odd ones, each followed by a copy of the next ones.
 *
 * The rows of an image, and all that is its, lie rotated by the whole pixels of the third shear, so
 * that fractions are left to shift by.
 *
 * The pixels of an image may be larger than the sky's. Then sample_lines takes the rows of its row
 * spectra, and the columns of its pixels, in steps of these, before the second shear.
 */

#if HAS_TURNS

/* Columns to the left and to the right of a row that a shift reaches; and the columns that a
 * work-item shifts one after the other, by weights that it holds.
 */
#define TURN_MARGIN (TURN_TAPS / 2)
#define TURN_POINTS (NX + 2 * TURN_MARGIN)
#define RUN 16
/* Blocks of rows that are copied: a shifted vector and its neighbours reach there. */
#define COPIED_BLOCKS ((LANES + TURN_TAPS / 2 + BLOCK - 1) / BLOCK)
#define PIECE (COLUMN_PAIRS + COPIED_BLOCKS * BLOCK)
#define PIECES (NY / 2 / COLUMN_PAIRS)
/* Columns lie far from each other in memory, as tiles do. */
#define COLUMNS_AHEAD 16

/* Reals that the columns of one image take. */
#define COLUMNS_SIZE ((size_t)PIECES * NX * 2 * PIECE)

INLINE size_t piece_start(const int piece, const int x)
{
    return ((size_t)piece * NX + x) * 2 * PIECE;
}

/* Even rows of a block of row pairs in column x, part 0, or odd ones, part 1; lane: one vector. */
INLINE void store_column(
    __global real *columns, const int x, const int part, const int lane, const int block,
    const vec value)
{
    const int blocks = COLUMN_PAIRS / BLOCK;
    int piece = block / blocks;
    for (int at = block % blocks; at < blocks + COPIED_BLOCKS; at += blocks) {
        __global vec *to = (__global vec *)(columns + piece_start(piece, x) + part * PIECE);
        to[at * SIDE + lane] = value;
        piece = piece > 0 ? piece - 1 : PIECES - 1;
    }
}

INLINE int in_row(const int x)
{
    return x < 0 ? x + NX : x < NX ? x : x - NX;
}

/* sampled = sum_k weights_ik given(firsts_i + k), 0 <= k < TURN_TAPS, for each line i, round the end: lines
 * in the steps of larger pixels, or the adjoint.
 * sampled, given: arrays [parts][stride][length] of vectors, of which lines, a multiple of RUN, are
 * taken; that of number `array` is read, that of number `to` written; a member has sampled_size and
 * given_size reals. firsts: [..][lines], 0 to lines - 1, and weights,
 * [..][lines][TURN_TAPS]: from line `table` on. Here and in the kernels below steps[GOING] 0: nothing.
 * Launch: up to parts * lines / RUN groups. Out of place. Twin: reference.sample_lines.
 */
KERNEL void sample_lines(
    __global vec *restrict sampled, __global const vec *restrict given, const int array,
    __global const int *restrict firsts, __global const real *restrict weights,
    __global const real *restrict steps, const int table, const int parts, const int lines,
    const int stride, const int length, const int to, const ulong sampled_size,
    const ulong given_size)
{
    const int runs = lines / RUN;
    OF_MEMBER(sampled, sampled_size / LANES);
    OF_MEMBER(given, given_size / LANES);
    OF_MEMBER(steps, N_NUMBERS);
    sampled += (size_t)to * parts * stride * length;
    given += (size_t)array * parts * stride * length;
    FOR_EACH_BLOCK_IF(steps[GOING], run, parts * runs) {
        const size_t part = (size_t)(run / runs) * stride * length;
        FOR_EACH(piece, RUN * length) {
            const int line = run % runs * RUN + piece / length, place = piece % length;
            const int first = firsts[table + line];
            vec total = 0;
            UNROLL
            for (int k = 0; k < TURN_TAPS; ++k) {
                const int at = first + k < lines ? first + k : first + k - lines;
                total += weights[TURN_TAPS * (table + line) + k]
                    * given[part + (size_t)at * length + place];
            }
            sampled[part + (size_t)line * length + place] = total;
        }
    }
}

/* z <- columns shifted along y, from column -margin to NX - 1 + margin, round the edge: sign 1, or
 * -1 for the adjoint, which shifts the other way, by the weights in reverse.
 */
INLINE void load_columns(
    SCRATCH vec *z, __global const real *columns, __global const int *shifts,
    __global const real *weights, const int block, const int sign, const int margin)
{
    FOR_EACH(piece, (NX + 2 * margin) * SIDE) {
        const int place = piece / SIDE, lane = piece % SIDE, x = in_row(place - margin);
        const int ahead = 2 * (block * BLOCK + lane * LANES);
        const int from = ahead + (sign > 0 ? shifts[x] : 1 - TURN_TAPS - shifts[x]);
        const int row = from < 0 ? from + NY : from < NY ? from : from - NY;
        /* Row k of those from here on is in one half of the column for an even k, else in the other. */
        const int odd = row % 2;
        __global const real *column =
            columns + piece_start(row / (2 * COLUMN_PAIRS), x) + row / 2 % COLUMN_PAIRS;
        __global const real *halves[2] = {column + odd * PIECE, column + (1 - odd) * PIECE + odd};
        UNROLL
        for (int i = 0; i < 2; ++i) {
            PREFETCH(halves[i] + COLUMNS_AHEAD * 2 * PIECE);
            PREFETCH(halves[i] + COLUMNS_AHEAD * 2 * PIECE + LANES + TURN_TAPS / 2);
        }
        cvec total = {0, 0};
        vec value = LOAD_UNALIGNED(halves[0]);
        UNROLL
        for (int k = 0; k < TURN_TAPS; ++k) {
            const real w = weights[TURN_TAPS * x + (sign > 0 ? k : TURN_TAPS - 1 - k)];
            total.re += w * value;
            value = LOAD_UNALIGNED(halves[(k + 1) % 2] + (k + 1) / 2);
            total.im += w * value;
        }
        STORE(z + lane, place, total);
    }
    BARRIER;
}

/* columns <- irfft_rows of the row spectra of an image.
 * spectra: N_SPECTRA arrays, const; `count` of them from number `array` on are read. columns: as many, as
 * above.
 * Launch: up to count * ROW_BLOCKS groups. Out of place. Scratch: NX points. Twin: reference.irfft_sheared.
 */
KERNEL void irfft_sheared(
    __global real *restrict columns, __global const vec *restrict spectra,
    __global const real *restrict steps, const int array, const int count, const ulong columns_size,
    const ulong spectra_size, __global const real *restrict row_roots,
    SCRATCH vec *restrict scratch)
{
    SCRATCH vec *z = OWN_SCRATCH(scratch, 2 * TURN_POINTS);
    OF_MEMBER(columns, columns_size);
    OF_MEMBER(spectra, spectra_size / LANES);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], unit, count * ROW_BLOCKS) {
        const int block = unit % ROW_BLOCKS, place = unit / ROW_BLOCKS;
        __global real *own = columns + place * COLUMNS_SIZE;
        read_tiles(z, spectra + (size_t)(array + place) * SPECTRA_SIZE, block);
        dit_inner(z, NX, row_roots);
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[OUTER(NX)];
            load_inverse(a, OF_LANE(z, lane), x, NX, row_roots);
            UNROLL
            for (int q = 0; q < OUTER(NX); ++q) {
                store_column(own, q * INNER(NX) + x, 0, lane, block, a[q].re);
                store_column(own, q * INNER(NX) + x, 1, lane, block, a[q].im);
            }
        }
        BARRIER;
    }
}

/* The second and the third shear of `columns`, the ratio with the image, and the adjoint of the
 * third: as ratio_rows, whose arguments are the same, for `count` images from `image` on.
 * columns, ratio_columns: as many arrays each, in and out. column_shifts, column_weights: [n_images][NX],
 * whole pixels less TURN_TAPS / 2 - 1, and [n_images][NX][TURN_TAPS]. image_weights: n_images arrays
 * [IMAGE_ROW_BLOCKS][TURN_TAPS][2][BLOCK]. Blocks from image_blocks on have no observed row: what
 * they have in ratio_columns and the sums is left as it is, 0.
 * Launch: up to count * image_blocks groups. Out of place. Scratch: 2 TURN_POINTS.
 * Twin: reference.ratio_sheared.
 */
KERNEL void ratio_sheared(
    __global real *restrict ratio_columns, __global const real *restrict columns,
    __global const int *restrict column_shifts, __global const real *restrict column_weights,
    __global const vec *restrict image_weights, const int image, const int count,
    const int image_blocks, __global real *restrict ratio_sums, __global real *restrict star_sums,
    __global const vec *restrict images, __global const vec *restrict background,
    const int has_background_map, __global const vec *restrict exposure, const int has_exposure_map,
    __global const vec *restrict star_images, __global const int *restrict star_corners,
    __global const int *restrict star_near, __global const real *restrict star_fluxes,
    __global const real *restrict steps, const int n_images, const int n_stars,
    const int star_blocks, const int star_columns, const ulong ratio_columns_size,
    const ulong columns_size, SCRATCH vec *restrict scratch)
{
    SHARED_SUMS(shared);
    SCRATCH vec *sheared = OWN_SCRATCH(scratch, 2 * TURN_POINTS);
    OF_MEMBER(ratio_columns, ratio_columns_size);
    OF_MEMBER(columns, columns_size);
    OF_MEMBER(ratio_sums, IMAGE_ROW_BLOCKS * n_images * 2);
    OF_MEMBER(star_sums, (size_t)n_stars * n_images * star_blocks * 2);
    OF_MEMBER(images, (size_t)n_images * IMAGE_SIZE);
    OF_MEMBER(star_fluxes, n_stars);
    OF_MEMBER(steps, N_NUMBERS);
    SCRATCH vec *wide = sheared + 2 * SIDE * TURN_POINTS;
    SCRATCH vec *z = wide + 2 * SIDE * TURN_MARGIN;
    FOR_EACH_BLOCK_IF(steps[GOING], unit, count * image_blocks) {
        const int block = unit % image_blocks, place = unit / image_blocks, turn = image + place;
        __global const vec *w =
            image_weights + ((size_t)turn * IMAGE_ROW_BLOCKS + block) * TURN_TAPS * 2 * SIDE;
        load_columns(
            sheared, columns + place * COLUMNS_SIZE, column_shifts + turn * NX,
            column_weights + turn * NX * TURN_TAPS, block, 1, TURN_MARGIN);
        FOR_EACH(piece, NX / RUN * 2 * SIDE) {
            const int part = piece % (2 * SIDE), start = piece / (2 * SIDE) * RUN;
            vec own[TURN_TAPS];
            UNROLL
            for (int k = 0; k < TURN_TAPS; ++k)
                own[k] = w[k * 2 * SIDE + part];
            for (int x = start; x < start + RUN; ++x) {
                vec total = 0;
                UNROLL
                for (int k = 0; k < TURN_TAPS; ++k)
                    total += own[k] * sheared[(x + k + 1) * 2 * SIDE + part];
                z[x * 2 * SIDE + part] = total;
            }
        }
        BARRIER;
        compare(
            z, ratio_sums, star_sums, images, background, has_background_map, exposure,
            has_exposure_map, star_images, star_corners, star_near, star_fluxes, n_images,
            star_blocks, star_columns, block, turn, shared);
        FOR_EACH(i, TURN_MARGIN * 2 * SIDE) {
            wide[i] = z[i + (NX - TURN_MARGIN) * 2 * SIDE];
            z[i + NX * 2 * SIDE] = z[i];
        }
        BARRIER;
        FOR_EACH(piece, NX / RUN * 2 * SIDE) {
            const int part = piece % (2 * SIDE), start = piece / (2 * SIDE) * RUN;
            vec own[TURN_TAPS];
            UNROLL
            for (int k = 0; k < TURN_TAPS; ++k)
                own[k] = w[k * 2 * SIDE + part];
            for (int x = start; x < start + RUN; ++x) {
                vec total = 0;
                UNROLL
                for (int k = 0; k < TURN_TAPS; ++k)
                    total += own[k] * wide[(x + TURN_TAPS - 1 - k) * 2 * SIDE + part];
                store_column(
                    ratio_columns + place * COLUMNS_SIZE, x, part / SIDE, part % SIDE, block,
                    total);
            }
        }
        BARRIER;
    }
}

/* columns <- the columns of an image after the adjoint of the second shear, which larger pixels have
 * apart: their columns are spread before the transform.
 * columns, ratio_columns: one array each, out and const in. The rest as for ratio_sheared, const.
 * Launch: up to ROW_BLOCKS groups. Out of place. Scratch: NX points. Twin: reference.unshear_columns.
 */
KERNEL void unshear_columns(
    __global real *restrict columns, __global const real *restrict ratio_columns,
    __global const int *restrict column_shifts, __global const real *restrict column_weights,
    __global const real *restrict steps, const int image, const ulong columns_size,
    const ulong ratio_columns_size, SCRATCH vec *restrict scratch)
{
    SCRATCH vec *z = OWN_SCRATCH(scratch, 2 * TURN_POINTS);
    OF_MEMBER(columns, columns_size);
    OF_MEMBER(ratio_columns, ratio_columns_size);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], block, ROW_BLOCKS) {
        load_columns(
            z, ratio_columns, column_shifts + image * NX, column_weights + image * NX * TURN_TAPS,
            block, -1, 0);
        FOR_EACH(piece, NX * 2 * SIDE) {
            const int x = piece / (2 * SIDE), part = piece / SIDE % 2, lane = piece % SIDE;
            store_column(columns, x, part, lane, block, z[piece]);
        }
        BARRIER;
    }
}

/* spectra <- rfft_rows of the columns of an image after the adjoint of the second shear.
 * spectra: N_SPECTRA arrays; `count` of them from number `array` on are written, all of them but their
 * padding.
 * The rest as for ratio_sheared, const.
 * Launch: up to count * ROW_BLOCKS groups. Out of place. Scratch: NX points. Twin: reference.rfft_sheared.
 */
KERNEL void rfft_sheared(
    __global vec *restrict spectra, __global const real *restrict ratio_columns,
    __global const int *restrict column_shifts, __global const real *restrict column_weights,
    __global const real *restrict steps, const int image, const int array, const int count,
    const ulong spectra_size, const ulong ratio_columns_size,
    __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    SCRATCH vec *z = OWN_SCRATCH(scratch, 2 * TURN_POINTS);
    OF_MEMBER(spectra, spectra_size / LANES);
    OF_MEMBER(ratio_columns, ratio_columns_size);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], unit, count * ROW_BLOCKS) {
        const int block = unit % ROW_BLOCKS, place = unit / ROW_BLOCKS, turn = image + place;
        load_columns(
            z, ratio_columns + place * COLUMNS_SIZE, column_shifts + turn * NX,
            column_weights + turn * NX * TURN_TAPS, block, -1, 0);
        begin_rows(z, NX, row_roots);
        dif_inner(z, NX, row_roots);
        write_tiles(spectra + (size_t)(array + place) * SPECTRA_SIZE, z, block, 1);
    }
}

#endif
