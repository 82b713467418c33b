// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <bit>
#include <cstdint>
#include <vector>

namespace roundel {

/// A code is a ring of black and white sectors around a roundel. Its word has a bit for each sector, 1 for
/// black, from the direction of the code's zero counter-clockwise as seen in front of the print.
using Word = uint32_t;
constexpr int kCodeSectors = 18;
constexpr int kCodeDistance = 4;  // sectors in which two words differ at least, at any turns
constexpr double kCodeInner = 1.45, kCodeOuter = 1.8;  // radii of the ring, outer radii of the roundel

/// The word of a print that is turned by so many sectors against its own zero.
constexpr Word turned(Word word, int sectors) {
    constexpr Word kAll = (Word(1) << kCodeSectors) - 1;
    const int s = (sectors % kCodeSectors + kCodeSectors) % kCodeSectors;
    return ((word << s) | (word >> (kCodeSectors - s))) & kAll;
}

/// The words of all codes, that of code 1 first: the lexicode (Conway and Sloane 1986) of the words that
/// differ in four sectors from each other at any turn, from themselves at any other turn, from all mirror
/// images, and from rings of one colour, and that have three black arcs or more, since edges and stripes of
/// other things make one or two.
const std::vector<Word>& code_words();

}  // namespace roundel
