/* Loops over the cells of the error of the mesh: their Neumann problems, and energies of blocks. */
#include <math.h>
#include <stddef.h>

#define INLINE static inline __attribute__((always_inline))

/* Replace the upper triangle of A (w, w) by the factor U of A = U'U; false where A is not positive
   definite. */
static int factorise(ptrdiff_t w, double *A)
{
  for (ptrdiff_t j = 0; j < w; j++) {
    double *row = A + j * w;
    if (!(row[j] > 0.0))
      return 0;
    double inverse = 1.0 / sqrt(row[j]);
    for (ptrdiff_t i = j; i < w; i++)
      row[i] *= inverse;
    for (ptrdiff_t k = j + 1; k < w; k++)
      for (ptrdiff_t i = k; i < w; i++)
        A[k * w + i] -= row[k] * row[i];
  }
  return 1;
}

/* The matrices G = B'A^{-1}B (k, s, s), (k, s, v), and the diagonals (k, v) of the columns of loads,
   for B = [lift (w, s), load (k, w, v)]; A (k, w, w) is lost. `work` has room for w * (s + v) + v
   numbers. Returns the number of cells before the first whose A is not positive definite. */
ptrdiff_t mesh_error_products(ptrdiff_t cells, ptrdiff_t w, ptrdiff_t s, ptrdiff_t v, double *A,
                              const double *lift, const double *load, double *matrix,
                              double *gradient, double *constant, double *work)
{
  ptrdiff_t n = s + v;
  for (ptrdiff_t k = 0; k < cells; k++) {
    double *U = A + k * w * w, *Y = work, *Q = matrix + k * s * s;
    double *g = gradient + k * s * v, *c = constant + k * v;
    if (!factorise(w, U))
      return k;
    for (ptrdiff_t i = 0; i < w; i++) {
      double *row = Y + i * n, inverse = 1.0 / U[i * w + i];
      for (ptrdiff_t a = 0; a < s; a++)
        row[a] = lift[i * s + a];
      for (ptrdiff_t a = 0; a < v; a++)
        row[s + a] = load[(k * w + i) * v + a];
      for (ptrdiff_t j = 0; j < i; j++) {
        const double u = U[j * w + i], *other = Y + j * n;
        for (ptrdiff_t a = 0; a < n; a++)
          row[a] -= u * other[a];
      }
      for (ptrdiff_t a = 0; a < n; a++)
        row[a] *= inverse;
      for (ptrdiff_t a = 0; a < s; a++) {
        for (ptrdiff_t b = a; b < s; b++)
          Q[a * s + b] += row[a] * row[b];
        for (ptrdiff_t b = 0; b < v; b++)
          g[a * v + b] += row[a] * row[s + b];
      }
      for (ptrdiff_t b = 0; b < v; b++)
        c[b] += row[s + b] * row[s + b];
    }
    for (ptrdiff_t a = 0; a < s; a++)
      for (ptrdiff_t b = 0; b < a; b++)
        Q[a * s + b] = Q[b * s + a];
  }
  return cells;
}

/* Add the energies (blocks, z, z) of blocks, see below; inlined for the usual z. */
INLINE void energies(ptrdiff_t z, ptrdiff_t blocks, ptrdiff_t c, ptrdiff_t h, ptrdiff_t j,
                     ptrdiff_t m, ptrdiff_t s, const ptrdiff_t *cell, const ptrdiff_t *row,
                     const ptrdiff_t *facet, const double *sign, const double *basis,
                     const double *Q, double *energy, double *work)
{
  double *Z = work, *QZ = work + h * m * z;
  for (ptrdiff_t r = 0; r < blocks; r++)
    for (ptrdiff_t q = 0; q < c; q++) {
      ptrdiff_t at = r * c + q;
      const ptrdiff_t *rows = row + at * h * m;
      double *E = energy + r * z * z;
      if (cell[at] < 0)
        continue;
      for (ptrdiff_t i = 0; i < h; i++)
        for (ptrdiff_t a = 0; a < m * z; a++)
          Z[i * m * z + a] = sign[at * h + i] * basis[(r * j + facet[at * h + i]) * m * z + a];
      for (ptrdiff_t a = 0; a < h * m; a++) {
        const double *of_row = Q + (cell[at] * s + rows[a]) * s;
        double *sum = QZ + a * z;
        for (ptrdiff_t y = 0; y < z; y++)
          sum[y] = 0.0;
        for (ptrdiff_t b = 0; b < h * m; b++)
          for (ptrdiff_t y = 0; y < z; y++)
            sum[y] += of_row[rows[b]] * Z[b * z + y];
        for (ptrdiff_t x = 0; x < z; x++)
          for (ptrdiff_t y = 0; y < z; y++)
            E[x * z + y] += Z[a * z + x] * sum[y];
      }
    }
}

/* Add the energies (blocks, z, z) of changes of moments, basis (blocks, j, m, z), on the facets of
   each block. A block has c cells with h facets each: `row` (blocks, c, h, m) are the places of a
   facet's moments among the s moments of a cell, `facet` (blocks, c, h) the facet's number in the
   block, `sign` (blocks, c, h) that of the cell's side; a cell below zero is none. The cells have
   the matrices Q (cells, s, s). `work` has room for 2 * h * m * z numbers. */
void mesh_error_energies(ptrdiff_t z, ptrdiff_t blocks, ptrdiff_t c, ptrdiff_t h, ptrdiff_t j,
                         ptrdiff_t m, ptrdiff_t s, const ptrdiff_t *cell, const ptrdiff_t *row,
                         const ptrdiff_t *facet, const double *sign, const double *basis,
                         const double *Q, double *energy, double *work)
{
#define ENERGIES(z) energies(z, blocks, c, h, j, m, s, cell, row, facet, sign, basis, Q, energy, work)
  if (z == 3)
    ENERGIES(3);
  else if (z == 6)
    ENERGIES(6);
  else
    ENERGIES(z);
}
