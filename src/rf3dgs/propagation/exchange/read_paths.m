function paths = read_paths(file)
%READ_PATHS  Propagation paths from an HDF5 file of rf3dgs.
%   paths = read_paths('site.paths') returns a struct array with one element per receiver:
%       coeff          complex amplitudes at the carrier, without the carrier's own exp(-2i*pi*frequency*delay)
%       delay          [s]
%       aoa_zenith, aoa_azimuth    where each path arrives from, seen from the receiver [rad]
%       aod_zenith, aod_azimuth    where it leaves to, seen from the transmitter [rad]
%       order, kind    number of interactions and their bit set (1 specular, 2 diffuse, 4 refraction, 8 diffraction);
%                      empty when the file does not say
%       position, orientation          of the receiver [m], quaternion wxyz of world from device
%       tx_position, tx_orientation    of the transmitter
%       frequency      [Hz]
%   World: right-handed, z up. Zenith from +z, azimuth from +x towards +y. A path contributes
%   coeff .* exp(-2i*pi*frequency*delay) to the narrow-band channel between isotropic antennas; abs(coeff).^2 is its gain.
%
%   The HDF5 library of this MATLAB must be 1.10 or later; [major, minor] = H5.get_libversion tells.
schema = deblank(char(h5readatt(file, '/', 'schema')));
if ~strncmp(schema, 'rf3dgs.paths', 12)
    error('rf3dgs:schema', '%s: expected a file of paths with schema rf3dgs.paths; it says %s.', file, schema);
end
if double(h5readatt(file, '/', 'version')) ~= 1
    error('rf3dgs:version', '%s: this reader knows version 1 of the schema.', file);
end
frequency = double(h5readatt(file, '/', 'frequency'));
offset = double(h5read(file, '/offset'));
position = double(h5read(file, '/rx_position'));        % 3 x N: MATLAB reverses the axes
orientation = double(h5read(file, '/rx_orientation'));
txPosition = double(h5read(file, '/tx_position'));
txOrientation = double(h5read(file, '/tx_orientation'));
coeff = complex(double(h5read(file, '/coeff_real')), double(h5read(file, '/coeff_imag')));
columns = {'delay', 'aoa_zenith', 'aoa_azimuth', 'aod_zenith', 'aod_azimuth'};
values = cell(size(columns));
for k = 1:numel(columns)
    values{k} = double(h5read(file, ['/' columns{k}]));
end
info = h5info(file);
names = {info.Datasets.Name};
optional = {'order', 'kind'};
counts = cell(size(optional));
for k = 1:numel(optional)
    if any(strcmp(names, optional{k}))
        counts{k} = double(h5read(file, ['/' optional{k}]));
    end
end
count = numel(offset) - 1;
paths = repmat(struct('coeff', [], 'delay', [], 'aoa_zenith', [], 'aoa_azimuth', [], 'aod_zenith', [], ...
    'aod_azimuth', [], 'order', [], 'kind', [], 'position', [], 'orientation', [], 'tx_position', txPosition(:)', ...
    'tx_orientation', txOrientation(:)', 'frequency', frequency), 1, count);
for i = 1:count
    part = offset(i) + 1 : offset(i + 1);
    paths(i).coeff = coeff(part);
    for k = 1:numel(columns)
        paths(i).(columns{k}) = values{k}(part);
    end
    for k = 1:numel(optional)
        if ~isempty(counts{k})
            paths(i).(optional{k}) = counts{k}(part);
        end
    end
    paths(i).position = position(:, i)';
    paths(i).orientation = orientation(:, i)';
end
end
